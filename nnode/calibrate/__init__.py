"""Calibration: costs, optimisers, the training loop, checkpoints and evaluation."""
