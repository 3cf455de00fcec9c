"""A driver as an OSI traffic participant: a unit with the variables of OSMP."""
