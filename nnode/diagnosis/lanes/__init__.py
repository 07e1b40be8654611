"""The engines of lanes: residuals of platoons behind their measured leader."""
