"""One file per format of recordings, and what they share."""
