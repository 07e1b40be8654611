"""The package's version, in a file that everything may import."""

from __future__ import annotations

VERSION = "0.1.0"
