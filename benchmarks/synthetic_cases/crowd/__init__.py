"""Crowds in which an effect is hidden."""
