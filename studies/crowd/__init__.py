"""Section 6 of the paper: people in a corridor."""

from studies.printed import published

#: Published figures.
printed = published(__name__)
