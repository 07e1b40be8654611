"""Platoons in which an effect is hidden."""
