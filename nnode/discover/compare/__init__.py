"""Which base law comes nearest, before anything is said to be missing."""
