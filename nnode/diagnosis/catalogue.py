"""The catalogue of effects as a table in Markdown.

python -m nnode.diagnosis.catalogue                      # prints it
python -m nnode.diagnosis.catalogue docs/discovery.md    # writes it between the file's marks
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import cast

from nnode.data.sequence import Domain
from nnode.errors import ConfigError
from nnode.files import write_text
from nnode.model.effects import CATALOGUE, Effect, IndividualEffect, Setting, Strength
from nnode.model.effects.own import load_own
from nnode.model.term import Interval

#: What stands before and after the table in a document.
MARKS = ("<!-- catalogue -->", "<!-- end of the catalogue -->")

_HEAD = "| effect | what | formula | plausible range | source |\n|---|---|---|---|---|"


def catalogue(own: bool = False) -> str:
    """Two tables, of traffic and of crowds.

    Args:
        own: with the user's own effects.
    """
    parts = []
    for domain, title in (("traffic", "Traffic"), ("crowd", "Crowds")):
        every = CATALOGUE.of(cast(Domain, domain), every=True)
        effects = [e for e in every if e.searched_orders and (own or _ours(e))]
        if effects:
            parts.append(f"### {title}\n\n{_HEAD}\n" + "\n".join(map(_row, effects)))
    return "\n\n".join(parts)


def written(text: str, table: str) -> str:
    """A document with the table between its marks.

    Raises:
        ConfigError: it has no such marks.
    """
    first, last = (text.find(mark) for mark in MARKS)
    if not 0 <= first < last:
        raise ConfigError(f"expected the lines {MARKS[0]} and {MARKS[1]} in the document")
    return f"{text[: first + len(MARKS[0])]}\n{table}\n{text[last:]}"


def _ours(effect: type[Effect]) -> bool:
    return effect.__module__.startswith("nnode.")


def _row(effect: type[Effect]) -> str:
    parameters: dict[str, Strength | Setting] = {**effect.strengths, **effect.settings}
    what = (effect.__doc__ or "").strip().partition("\n")[0].rstrip(".")
    ranges = [f"{name}: {_range(given)}" for name, given in parameters.items()]
    if issubclass(effect, IndividualEffect):
        ranges.append("one value per agent")
    cells = (
        f"`{effect.name}`",
        what,
        "; ".join(effect.formula_lines()),
        "; ".join(ranges),
        effect.source,
    )
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def _range(given: Strength | Setting) -> str:
    unit = "" if given.unit in ("", "1") else f" {given.unit}"
    if given.range == Interval():
        return f"any{unit and f', in{unit}'}"
    low, high = (_number(value) for value in (given.range.low, given.range.high))
    return f"{low} to {high}{unit}{_usual(given)}"


def _usual(given: Strength | Setting) -> str:
    if not isinstance(given, Strength) or given.min_effect_size is None:
        return ""
    away = f" away from {_number(given.neutral)}" if given.neutral else ""
    return f", usually {_number(given.min_effect_size)} or more{away}"


def _number(value: float) -> str:
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    return f"{value:g}".replace("-", "−")


def main(arguments: list[str]) -> None:
    """Print the catalogue, or write it into the document that is named."""
    if not arguments:
        load_own()
        print(catalogue(own=True))
        return
    path = Path(arguments[0])
    write_text(path, written(path.read_text(encoding="utf-8"), catalogue()))
    print(f"written: {path}")


if __name__ == "__main__":
    main(sys.argv[1:])
