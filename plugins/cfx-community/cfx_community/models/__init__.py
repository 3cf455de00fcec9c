"""Classic driving models, and variants of IDM."""
