"""Comparison of base laws, before effects are selected."""
