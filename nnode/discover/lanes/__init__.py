"""What only traffic needs: residuals of whole platoons behind their measured leader."""
