"""Gauss and Newton's method on exact tangents: pooled, alone or shrunk, with intervals."""
