"""Stepwise selection of the effects of the catalogue that a model lacks."""
