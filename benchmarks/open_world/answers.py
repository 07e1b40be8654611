"""What is right to say of a scene, and what was said."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import pandas as pd

from nnode.data.sequence import Domain

#: Names of one thing: a time gap of everybody's own, as it is seen at first or as it is estimated.
SAME = {"lasting_time_gap": "driver_heterogeneity"}


@dataclass(frozen=True, kw_only=True)
class Answer:
    """Written down before a scene is run.

    Attributes:
        first: laws that are right to come first; empty: any.
        right: names that are right, all of them; empty: none.
        allowed: names that may stand beside them or alone: the true law has them in itself.
        unknown: whether ``unknown`` is right as well, or some of ``right``.
    """

    first: tuple[str, ...] = ()
    right: tuple[str, ...] = ()
    allowed: tuple[str, ...] = ()
    unknown: bool = False

    def judge(self, report: dict[str, Any], nearest: dict[str, Any] | None) -> dict[str, Any]:
        """What was said of the law that comes nearest, against this; plain JSON.

        Args:
            report: of the law that was asked for.
            nearest: of the one that comes nearest; None where it is the same.
        """
        last = report if nearest is None else nearest
        first = (report["laws_again"] or report["laws"])["ranking"][0]["name"]
        names = [self.called(effect) for effect in last["effects"]]
        missing = [name for name in self.right if name not in names]
        false = [name for name in names if name not in (*self.right, *self.allowed)]
        unsure = self.unknown and (bool(names) or last["verdict"] == "unknown")
        return {
            "first": first,
            "law_known": bool(self.first),
            "law_right": not self.first or first in self.first,
            "verdict": last["verdict"],
            "names": names,
            "leads": [effect["name"] for effect in last["leads"]],
            "right": not false and (not missing or unsure),
            "false": false,
            "asked_verdict": report["verdict"],
            "asked_names": [effect["name"] for effect in report["effects"]],
        }

    def called(self, effect: dict[str, Any]) -> str:
        """A name that is right, where it is the effect's or one of its equals'; else the
        effect's."""
        names = [effect["name"], *(other["name"] for other in effect["alternatives"])]
        names = [SAME.get(name, name) for name in names]
        known = (name for name in names if name in (*self.right, *self.allowed))
        return next(known, names[0])


def diagnosed(
    table: pd.DataFrame, domain: Domain, seed: int, **how: Any
) -> tuple[dict[str, Any], dict[str, Any] | None, float]:
    """A diagnosis of a law and that of the nearest one, plain JSON, and how long it took, s.

    Args:
        how: further arguments of :func:`nnode.diagnose`.

    Returns:
        None as the second where the law that was asked for comes nearest.
    """
    from nnode.app.discover import diagnose_table
    from nnode.discover.options import DiscoverOptions

    start = time.monotonic()
    options = DiscoverOptions(page=False, replay=False)
    found = diagnose_table(table, domain, seed=seed, options=options, **how)
    nearest = None if found.nearest is None else found.nearest.plain()
    return found.plain(), nearest, time.monotonic() - start


#: No name is right, and every law may come first.
NOTHING = Answer()
