"""Diagnosis: where a model is wrong, which effect is missing, and what adding it changes."""
