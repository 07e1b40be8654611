"""All engines on the same problems: ``scripts/benchmark.py``."""
