"""Contract suites that every component and every plugin passes."""
