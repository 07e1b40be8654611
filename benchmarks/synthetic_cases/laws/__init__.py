"""Platoons that follow a law of the literature, written out by hand."""
