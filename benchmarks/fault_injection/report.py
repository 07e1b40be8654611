"""What a campaign came to, one table over all, and the file that keeps them."""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from nnode.files import write_json

REPORT = "report.json"


@dataclass
class Row:
    """One line of the table.

    Attributes:
        campaign: kills, disk, folder or fuzz.
        what: what was tested.
        tried: how often.
        losses: what went wrong each time, in words; empty is what is promised.
        seconds: for all of them.
        facts: further counts.
    """

    campaign: str
    what: str
    tried: int
    losses: list[str] = field(default_factory=list)
    seconds: float = 0.0
    facts: dict[str, Any] = field(default_factory=dict)


def keep(folder: Path, campaign: str, rows: list[Row], how: dict[str, Any]) -> list[Row]:
    """Put a campaign's rows into the report, in the place of its earlier ones; returns all."""
    path = folder / REPORT
    try:
        known = [Row(**row) for row in json.loads(path.read_text(encoding="utf-8"))["rows"]]
    except (OSError, ValueError, KeyError, TypeError):
        known = []
    merged = [row for row in known if row.campaign != campaign] + rows
    order = {name: i for i, name in enumerate(("kills", "disk", "folder", "fuzz"))}
    merged.sort(key=lambda row: order.get(row.campaign, len(order)))
    when = time.strftime("%Y-%m-%d %H:%M:%S")
    content = {
        "rows": [asdict(row) for row in merged],
        "tried": {c: sum(r.tried for r in merged if r.campaign == c) for c in order},
        "losses": sum(len(row.losses) for row in merged),
        "made": {"when": when, **how},
    }
    write_json(path, content)
    return merged


def show(rows: list[Row]) -> None:
    """Print the table, and every loss below it."""
    table = Table(title="fault injection: what was tried, and what was lost")
    for name in ("campaign", "what", "tried", "losses", "per second", "more"):
        table.add_column(name, justify="left" if name in ("campaign", "what", "more") else "right")
    for row in rows:
        more = ", ".join(f"{name} {value}" for name, value in row.facts.items())
        speed = f"{row.tried / row.seconds:.3g}" if row.seconds else ""
        table.add_row(row.campaign, row.what, str(row.tried), str(len(row.losses)), speed, more)
    Console(width=140).print(table)
    for row in rows:
        for loss in row.losses:
            print(f"LOSS {row.campaign}, {row.what}: {loss}")
