"""The tables of results that cfx's own protocols deliver, and that of results by site."""
