"""Platoons and crowds of other base laws: which law ranks first, and which effects are named.

The worlds are platoons of laws of the literature (:mod:`benchmarks.synthetic_cases.laws`), and
scenes that SUMO and JuPedSim simulate. The right answers were written down before anything was
run.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.config import DiscoveryBenchmarkOptions
from benchmarks.synthetic_cases.laws import FIRST_ORDER, RANGES, measured
from benchmarks.synthetic_cases.score import UNKNOWN, judged
from nnode.app import discover
from nnode.discover.options import DiscoverOptions

#: Effects of a law of second order that a law of the first or of the second order lacks: those of
#: its linearisation (speed difference, lag, a gap that grows with the speed ahead, a highest
#: speed), and how strongly, how evenly and how late drivers respond to speeds.
_RESPONSE = ("relative_speed", "asymmetric_response", "inertia", "reaction_delay")
LACKING = {"first": (*_RESPONSE, "time_gap", "free_flow_speed"), "second": _RESPONSE}
#: Columns of :func:`~benchmarks.synthetic_cases.score.judged` in a row.
_SHOWN = ("false_name", "verdict", "named", "hypotheses", "false_names")
#: Modules of the programs that simulate scenes, with the domain and the requested model.
PROGRAMS: dict[str, tuple[str, str, Any]] = {
    "sumo": ("benchmarks.discovery.sumo_scenes", "traffic", "idm"),
    "jupedsim": (
        "benchmarks.discovery.jupedsim_scenes",
        "crowd",
        {"name": "sf", "term": "social_force", "desired": "direction", "walls": False},
    ),
}


@dataclass(frozen=True, kw_only=True)
class Answer:
    """The right answer for a world.

    Attributes:
        first: laws of which one should rank first; empty: any.
        right: effects that should all be named; empty: none.
        allowed: effects that may be named as well, because the true law contains them.
        unknown: whether ``unknown``, or some of ``right``, is right too.
    """

    first: tuple[str, ...] = ()
    right: tuple[str, ...] = ()
    allowed: tuple[str, ...] = ()
    unknown: bool = False

    def judge(self, report: dict[str, Any]) -> dict[str, Any]:
        """The row of a diagnosis."""
        row = judged(report, self.right, self.allowed)
        unsure = self.unknown and (row["named"] or row["verdict"] == UNKNOWN)
        right = not row["false_name"] and bool(unsure or not row["missing"])
        return {"right": right} | {name: row[name] for name in _SHOWN}


#: No name is right, and any law may rank first.
NOTHING = Answer()


def allowed(true: str, diagnosed: str) -> tuple[str, ...]:
    """Effects that the true law has and the diagnosed law lacks."""
    if true == diagnosed:
        return ()
    # gaps of lin and log contain the length of the vehicle ahead
    length = ("leader_length",) if (true in FIRST_ORDER) != (diagnosed in FIRST_ORDER) else ()
    return (*length, *LACKING["first" if diagnosed in FIRST_ORDER else "second"])


def cases(kind: str, options: DiscoveryBenchmarkOptions, first: int) -> dict[str, Any]:
    """``seeds`` worlds of every law or scene; half of the laws' worlds are given to ``lin``."""
    scenes = RANGES if kind == "laws" else import_module(PROGRAMS[kind][0]).SCENES
    found: dict[str, Any] = {}
    for scene in scenes:
        for i in range(options.seeds):
            requested = ("lin", "idm")[i % 2] if kind == "laws" else ""
            key = f"{kind}-{scene}-s{first + i}"
            found[key] = {"program": kind, "scene": scene, "seed": first + i, "law": requested}
    return found


def evaluate(program: str, scene: str, seed: int, law: str = "") -> dict[str, list[dict[str, Any]]]:
    """One world, diagnosed: a row of the best-fitting law, and of laws one of the requested law.

    Args:
        law: the requested one, if ``program`` is ``laws``.
    """
    options, walls = DiscoverOptions(page=False, replay=False), None
    with TemporaryDirectory() as folder:
        if program == "laws":
            table, domain, model = measured(scene, seed)[0], "traffic", law
        else:
            name, domain, model = PROGRAMS[program]
            scenes = import_module(name)
            table, known = scenes.recorded(scene, seed)
            if known is not None:
                walls = Path(folder) / "walls.csv"
                known.to_csv(walls, index=False)
        start = time.monotonic()
        found = discover.diagnose_table(
            table, domain, seed=seed, options=options, model=model, walls=walls
        )
    report = found.plain()
    ranking = (report["laws_again"] or report["laws"])["ranking"]
    first = ranking[0]["name"]
    answer = Answer(first=(scene,), allowed=allowed(scene, first))
    if program != "laws":
        answer = scenes.SCENES[scene].answer
    row = {"program": program, "scene": scene, "seed": seed}
    best = report if found.nearest is None else found.nearest.plain()
    rows = [
        {
            **row,
            "diagnosed": "best-fitting law",
            "law": first,
            "law_first": first in answer.first if answer.first else None,
            **answer.judge(best),
            "seconds": time.monotonic() - start,
        }
    ]
    if program == "laws" and found.nearest is not None:
        of_requested = Answer(allowed=allowed(scene, law))
        rows.append({**row, "diagnosed": "requested law", "law": law, **of_requested.judge(report)})
    return {"worlds": rows}
