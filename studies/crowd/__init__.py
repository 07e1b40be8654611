"""Section 6 of the paper: people in a corridor."""
