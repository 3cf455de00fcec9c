"""Protocols: who is calibrated, trained and tested on what."""
