"""The contracts of all kinds as plain functions, one module per kind; none needs pytest."""
