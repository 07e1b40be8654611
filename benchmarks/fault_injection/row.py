"""What a campaign came to."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any


@dataclass
class Row:
    """One line of the table.

    Attributes:
        what: what was tested.
        tried: how often.
        losses: what went wrong each time, in words; empty is what is promised.
        seconds: for all of them.
        facts: further counts.
    """

    what: str
    tried: int = 0
    losses: list[str] = field(default_factory=list)
    seconds: float = field(default_factory=lambda: -time.monotonic())
    facts: dict[str, Any] = field(default_factory=dict)

    def ended(self) -> Row:
        """The row of a test that ends now; it began when the row was made."""
        self.seconds += time.monotonic()
        return self
