"""Figures of a diagnosis: deviations of the model from the data, before and after."""
