"""Misuse on purpose: ``scripts/torture.py``."""
