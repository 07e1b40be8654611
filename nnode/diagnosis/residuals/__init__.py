"""Residuals of models, and calibration to them; the same in every domain."""
