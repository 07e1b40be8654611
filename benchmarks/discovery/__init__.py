"""The diagnosis against hidden truths: ``scripts/benchmark_discovery.py``."""
