"""The jobs that the scripts start: each composes what the packages below offer."""
