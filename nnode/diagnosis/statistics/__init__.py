"""Score tests, J tests, intervals, power, and variance components between agents."""
