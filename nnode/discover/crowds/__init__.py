"""What only crowds need: residuals on short windows in which every person walks alone."""
