"""Which effect of the catalogue it lacks: one after the other is added, or taken back."""
