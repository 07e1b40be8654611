"""The engine of crowds: people who differ, each simulated alone in windows of time."""
