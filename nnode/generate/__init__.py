"""Sampled motion: a calibrated model with noise, and drivers drawn at random, and its scores."""
