"""The sections of the report that cfx brings."""
