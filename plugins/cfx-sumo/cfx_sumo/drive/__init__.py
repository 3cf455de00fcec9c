"""`cfx drive`: whole scenarios in which policies drive."""
