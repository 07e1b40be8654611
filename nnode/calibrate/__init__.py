"""Calibration: cost, optimisers, the training loop, checkpoints, evaluation."""
