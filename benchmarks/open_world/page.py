"""How often the true law comes first, and what is named beside it, as a page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd
from scipy.stats import binomtest

from nnode.machine import how_made
from nnode.pages.page import Block, Heading, Provenance, TableBlock, Text, write_page

TITLE = "Open worlds"

_JUDGED = (
    "What is judged is the diagnosis of the law that comes nearest. The answers were written down "
    "before"
)
#: Programs that simulate scenes, and what is done with them.
PROGRAMS = {
    "SUMO": "Forty platoons each, whose followers SUMO drives, diagnosed with `idm`. "
    f"{_JUDGED} (`benchmarks/open_world/by_sumo.py`).",
    "JuPedSim": "Twenty-four meetings of two groups each, whom JuPedSim moves, diagnosed with "
    f"`sf`. {_JUDGED} (`benchmarks/open_world/by_jupedsim.py`).",
}


def share(number: int, of: int) -> str:
    """A proportion with its exact interval of 95 %."""
    if not of:
        return "–"
    low, high = binomtest(number, of).proportion_ci()
    return f"{number} of {of} ({100 * number / of:.0f} %, {100 * low:.0f}–{100 * high:.0f} %)"


def criteria(rows: list[dict[str, Any]]) -> pd.DataFrame:
    """What is asked for, and what was reached."""
    first = sum(row["first"] == row["law"] for row in rows)
    # who cannot be told from the first is no wrong answer, but no right one either
    tied = sum(row["first"] != row["law"] and (row["p"] or 0) > 0.05 for row in rows)
    diagnoses = [
        (row, who)
        for row in rows
        for who in ("asked", "nearest")
        if who == "asked" or row["first"] != row["asked"]
    ]
    false = sum(bool(row[f"{who}_false"]) for row, who in diagnoses)
    own = [row for row in rows if row["first"] == row["law"]]
    silent = sum(not row["nearest_names"] for row in own)
    lines = [
        ("the true law comes first", "90 %", share(first, len(rows))),
        ("another one comes first, not told from it (p > 0.05)", "", share(tied, len(rows))),
        ("a diagnosis names something false", "5 %", share(false, len(diagnoses))),
        ("the diagnosis of the true law names nothing", "", share(silent, len(own))),
    ]
    return pd.DataFrame(lines, columns=["what", "asked for", "reached"])


def by_law(rows: list[dict[str, Any]]) -> pd.DataFrame:
    """One line for every true law."""
    lines = []
    for law in dict.fromkeys(row["law"] for row in rows):
        own = [row for row in rows if row["law"] == law]
        others = sorted({row["first"] for row in own} - {law})
        named = sorted({n for row in own for w in ("asked", "nearest") for n in row[f"{w}_names"]})
        false = sorted({n for row in own for w in ("asked", "nearest") for n in row[f"{w}_false"]})
        lines.append(
            {
                "true law": law,
                "first": f"{sum(row['first'] == law for row in own)} of {len(own)}",
                "else first": ", ".join(others),
                "named": ", ".join(named),
                "of these false": ", ".join(false),
            }
        )
    return pd.DataFrame(lines)


def scene_criteria(rows: list[dict[str, Any]]) -> pd.DataFrame:
    """What is asked for of the scenes, and what was reached."""
    known = [row for row in rows if row["law_known"]]
    lines = [
        ("the written answer", "85 %", share(sum(row["right"] for row in rows), len(rows))),
        ("a false name", "5 %", share(sum(bool(row["false"]) for row in rows), len(rows))),
        (
            "the law that the program has comes first",
            "",
            share(sum(row["law_right"] for row in known), len(known)),
        ),
    ]
    return pd.DataFrame(lines, columns=["what", "asked for", "reached"])


def write(rows: list[dict[str, Any]], seeds_of: str | None, folder: Path) -> list[Path]:
    """The page, as Markdown, and its tables; returns their paths."""
    blocks: list[Block] = []
    worlds, scenes = ([r for r in rows if kind in r] for kind in ("law", "scene"))
    if worlds:
        flat = pd.DataFrame(worlds).drop(columns="parameters")
        blocks += [
            Heading("The base law is wrong"),
            Text(
                "Platoons of one law, written out by hand, are diagnosed with `lin` or `idm`: "
                "which law comes first, and is anything named that the true law lacks? What is "
                "right was written down before (`benchmarks/open_world/laws.py`)."
            ),
            TableBlock("criteria", criteria(worlds), "Shares with exact intervals of 95 %."),
            TableBlock("laws", by_law(worlds), "By the law that is true."),
            TableBlock("worlds", flat, "Every world."),
        ]
    for program, words in PROGRAMS.items():
        own = [row for row in scenes if row["program"] == program]
        if own:
            stem = program.lower()
            blocks += [
                Heading(f"Scenes by {program}"),
                Text(words),
                TableBlock(f"{stem}_criteria", scene_criteria(own), "Shares, 95 % intervals."),
                TableBlock(stem, pd.DataFrame(own), "Every scene."),
            ]
    made = how_made(("torch", "numpy", "scipy"))
    blocks.append(Provenance({**made, "Seeds of": seeds_of or "none: development"}))
    return write_page(
        blocks, folder, title=TITLE, subtitle="Which law, and what beside it.", stem="open_world"
    )
