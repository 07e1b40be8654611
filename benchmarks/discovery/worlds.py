"""Platoons and crowds of other base laws: which law ranks first, and which effects are named.

The worlds are platoons of laws of the literature (:mod:`benchmarks.synthetic_cases.laws`), and
scenes that SUMO and JuPedSim simulate (``scenes.yaml``). The right answers were written down before
anything was run.
"""

from __future__ import annotations

import time
from collections.abc import Collection
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.config import DiscoveryBenchmarkOptions
from benchmarks.discovery.scenes import SCENES
from benchmarks.synthetic_cases.laws import FIRST_ORDER, RANGES, measured
from benchmarks.synthetic_cases.score import UNKNOWN, judged
from nnode.app import discover
from nnode.diagnosis.options import DiscoverOptions

#: Effects of a law of second order that a law of the first or of the second order lacks: those of
#: its linearisation (speed difference, lag, a gap that grows with the speed ahead, a highest
#: speed), and how strongly, how evenly and how late drivers respond to speeds.
_RESPONSE = ("relative_speed", "asymmetric_response", "inertia", "reaction_delay")
LACKING = {"first": (*_RESPONSE, "time_gap", "free_flow_speed"), "second": _RESPONSE}
#: Columns of :func:`~benchmarks.synthetic_cases.score.judged` in a row.
_SHOWN = ("false_name", "verdict", "named", "hypotheses", "false_names")
#: Programs that simulate scenes, with the domain and the requested model.
PROGRAMS: dict[str, tuple[str, Any]] = {
    "sumo": ("traffic", "idm"),
    "jupedsim": (
        "crowd",
        {"name": "sf", "term": "social_force", "desired": "direction", "walls": False},
    ),
}


def answered(
    report: dict[str, Any],
    *,
    first: Collection[str] = (),
    right: Collection[str] = (),
    allowed: Collection[str] = (),
    unknown: bool = False,
) -> dict[str, Any]:
    """The row of a diagnosis; the right answer is that of ``scenes.yaml``."""
    row = judged(report, right, allowed)
    unsure = unknown and (row["named"] or row["verdict"] == UNKNOWN)
    correct = not row["false_name"] and bool(unsure or not row["missing"])
    return {"right": correct} | {name: row[name] for name in _SHOWN}


def allowed(true: str, diagnosed: str) -> tuple[str, ...]:
    """Effects that the true law has and the diagnosed law lacks."""
    if true == diagnosed:
        return ()
    # gaps of lin and log contain the length of the vehicle ahead
    length = ("leader_length",) if (true in FIRST_ORDER) != (diagnosed in FIRST_ORDER) else ()
    return (*length, *LACKING["first" if diagnosed in FIRST_ORDER else "second"])


def cases(kind: str, options: DiscoveryBenchmarkOptions, first: int) -> dict[str, Any]:
    """``seeds`` worlds of every law or scene; half of the laws' worlds are given to ``lin``."""
    return {
        f"{kind}-{scene}-s{first + i}": {
            "program": kind,
            "scene": scene,
            "seed": first + i,
            "law": ("lin", "idm")[i % 2] if kind == "laws" else "",
        }
        for scene in (RANGES if kind == "laws" else SCENES[kind])
        for i in range(options.seeds)
    }


def evaluate(program: str, scene: str, seed: int, law: str = "") -> dict[str, list[dict[str, Any]]]:
    """One world, diagnosed: a row of the best-fitting law, and of laws one of the requested law.

    Args:
        law: the requested one, if ``program`` is ``laws``.
    """
    options, walls = DiscoverOptions(page=False, replay=False), None
    domain, model = PROGRAMS.get(program, ("traffic", law))
    with TemporaryDirectory() as folder:
        if program == "laws":
            table = measured(scene, seed)[0]
        else:
            scenes = import_module(f"benchmarks.discovery.{program}_scenes")
            table, boundaries = scenes.recorded(scene, seed)
            if boundaries is not None:
                walls = Path(folder) / "walls.csv"
                boundaries.to_csv(walls, index=False)
        start = time.monotonic()
        diagnosis = discover.diagnose_table(
            table, domain, seed=seed, options=options, model=model, walls=walls
        )
    report, nearest = diagnosis.plain(), diagnosis.nearest
    best_law = (report["laws_again"] or report["laws"])["ranking"][0]["name"]
    if program == "laws":
        answer: dict[str, Any] = {"first": (scene,), "allowed": allowed(scene, best_law)}
    else:
        answer = SCENES[program][scene]["answer"]
    row = {"program": program, "scene": scene, "seed": seed}
    rows = [
        {
            **row,
            "diagnosed": "best-fitting law",
            "law": best_law,
            "law_first": best_law in answer["first"] if "first" in answer else None,
            **answered(report if nearest is None else nearest.plain(), **answer),
            "seconds": time.monotonic() - start,
        }
    ]
    if program == "laws" and nearest is not None:
        requested = answered(report, allowed=allowed(scene, law))
        rows.append({**row, "diagnosed": "requested law", "law": law, **requested})
    return {"worlds": rows}
