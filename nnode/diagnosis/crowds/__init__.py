"""The engine of crowds: residuals on short windows with every person simulated alone."""
