"""Figures of a diagnosis: where a model parts from measurement, before and after."""
