"""The jobs that the commands start: each composes what the packages below offer."""
