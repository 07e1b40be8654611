"""What a model leaves of the measurement, and its calibration to that; the same in every domain."""
