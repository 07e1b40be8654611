"""Where people want to go, where the data tell it: exit lines, or headings, by direction and group.

Everybody's exit is one for his group, or else for all, and for his direction; of several the
nearest to where he was last seen. His destination is the nearest point of its line to where he is
at the start of the sequence; with a heading in place of a line it is far ahead.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from nnode.data.trajectories import Trajectories
from nnode.errors import ConfigError, DataError

#: m; so far ahead lies the destination of who walks in a direction.
FAR = 1e4

#: Directions by their words.
DIRECTIONS = {"+x": (1.0, 0.0), "-x": (-1.0, 0.0), "+y": (0.0, 1.0), "-y": (0.0, -1.0)}

_KEYS = ("line", "heading", "direction", "group")


@dataclass(frozen=True)
class Exit:
    """Where some people want to go.

    Attributes:
        name: of the exit.
        line: ``(2, 2)`` m, its two end points, or None.
        heading: ``(2,)`` of length 1, in place of a line.
        direction: ``(2,)`` of length 1: the exit is for those who walk this way; None: for all.
        group: the exit is for this group; None: for all.
    """

    name: str
    line: np.ndarray | None = None
    heading: np.ndarray | None = None
    direction: np.ndarray | None = None
    group: str | None = None

    def point(self, x: np.ndarray) -> np.ndarray:
        """``(2,)`` m, the destination of who is at ``x``."""
        if self.line is None:
            assert self.heading is not None
            return np.asarray(x + FAR * self.heading)
        start, along = self.line[0], self.line[1] - self.line[0]
        share = np.clip((x - start) @ along / (along @ along), 0.0, 1.0)
        return np.asarray(start + share * along)


def read_exits(exits: Any) -> list[Exit]:
    """Exits of ``data.exits``.

    Args:
        exits: ``{name: {line: [x1, y1, x2, y2], direction: +x, group: NAME}}`` (m), with
            ``heading`` ([x, y] or a word as for ``direction``) in place of ``line``; or None.

    Raises:
        ConfigError: names the exit and what is wrong with it.
    """
    read = []
    for name, entry in dict(exits or {}).items():
        if not isinstance(entry, Mapping) or not set(entry) <= set(_KEYS):
            raise ConfigError(
                f"data.exits.{name}={entry}: expected some of {', '.join(_KEYS)}, such as "
                "{line: [5, 0, 5, 4], direction: +x}"
            )
        if (entry.get("line") is None) == (entry.get("heading") is None):
            raise ConfigError(f"data.exits.{name}={dict(entry)}: expected a line or a heading")
        line = None
        if entry.get("line") is not None:
            line = _numbers(f"{name}.line", entry["line"], 4).reshape(2, 2)
            if (line[0] == line[1]).all():
                raise ConfigError(f"data.exits.{name}.line: ends where it begins")
        group = entry.get("group")
        read.append(
            Exit(
                name=str(name),
                line=line,
                heading=_unit(f"{name}.heading", entry.get("heading")),
                direction=_unit(f"{name}.direction", entry.get("direction")),
                group=None if group is None else str(group),
            )
        )
    return read


def _numbers(what: str, value: Any, number: int) -> np.ndarray:
    try:
        numbers = np.array([float(item) for item in value])
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape != (number,) or not np.isfinite(numbers).all():
        raise ConfigError(f"data.exits.{what}={value}: expected {number} numbers")
    return numbers


def _unit(what: str, value: Any) -> np.ndarray | None:
    if value is None:
        return None
    if isinstance(value, str):
        if value not in DIRECTIONS:
            raise ConfigError(
                f"data.exits.{what}={value}: expected [x, y] or one of {', '.join(DIRECTIONS)}"
            )
        return np.array(DIRECTIONS[value])
    way = _numbers(what, value, 2)
    if not way.any():
        raise ConfigError(f"data.exits.{what}={value}: expected a direction, not zero")
    return np.asarray(way / np.linalg.norm(way))


def exits_of(
    exits: list[Exit], rows: Trajectories, people: Iterable[np.ndarray]
) -> Iterator[tuple[int, Exit]]:
    """Everybody's first row with a position, and his exit by his first and last one.

    Args:
        exits: at least one.
        rows: of people.
        people: rows of everyone, in order of time.

    Raises:
        DataError: somebody whom no exit is for.
    """
    for of_person in people:
        located = of_person[np.isfinite(rows.x[of_person]).all(axis=1)]
        start, end = (located if located.size else of_person)[[0, -1]]
        first, last = rows.x[start], rows.x[end]
        way, group = last - first, None if rows.group is None else rows.group[start]
        fits = [
            exit_
            for exit_ in exits
            if exit_.group in (None, group)
            and (exit_.direction is None or way @ exit_.direction > 0)
        ]
        if not fits:
            whose = f" of group {group!r}" if group else ""
            raise DataError(
                f"{rows.path}: no exit (data.exits) is for person {rows.agent[start]}{whose}, who "
                f"goes from ({first[0]:.1f}, {first[1]:.1f}) m to ({last[0]:.1f}, {last[1]:.1f}) "
                "m; add one without direction and group"
            )
        # what is for a group goes before what is for all
        candidates = [exit_ for exit_ in fits if exit_.group is not None] or fits
        yield int(start), min(candidates, key=lambda exit_: _distance(exit_, last, way))


def _distance(exit_: Exit, last: np.ndarray, way: np.ndarray) -> float:
    """m from where somebody was last seen; of a heading, the part of the way aside or back."""
    if exit_.heading is None:
        return float(np.linalg.norm(exit_.point(last) - last))
    return float(np.linalg.norm(way - max(way @ exit_.heading, 0.0) * exit_.heading))
