"""Section 5 of the paper: cars, five models on ten recordings."""
