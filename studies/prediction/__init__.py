"""Public benchmarks of prediction: people behind automated cars, and people in open scenes."""

from studies.printed import published

#: Published figures.
printed = published(__name__)
