"""Mixed-effects models: a law, agent-specific parameters, disturbances and errors."""
