"""Motion sampled from a calibrated model with noise and random drivers, and its scores."""
