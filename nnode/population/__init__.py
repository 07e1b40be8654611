"""Agents who differ: a law, the agents' own parameters, disturbances that last, errors."""
