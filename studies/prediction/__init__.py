"""Public benchmarks of prediction: people behind automated cars, and people in open scenes."""
