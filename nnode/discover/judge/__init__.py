"""Verdicts on the selected effects, and their confirmation on held-back clusters."""
