"""Models, optimizers and policies of the literature, kept apart from the core of cfx."""
