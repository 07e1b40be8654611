"""Misuse on purpose: ``scripts/fault_injection.py``."""
