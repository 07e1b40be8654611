"""Where the model deviates from the data: nonparametric curves of the residuals."""
