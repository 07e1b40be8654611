"""What is chance and what is not: scores, intervals, paired tests, agents who differ."""
