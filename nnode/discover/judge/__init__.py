"""What may be said of it: verdicts, and the sealed clusters that confirm them or not."""
