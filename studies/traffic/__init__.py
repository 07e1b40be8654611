"""Section 5 of the paper: cars, five models on ten recordings."""

from studies.printed import published

#: Published figures.
printed = published(__name__)
