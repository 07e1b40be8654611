"""Platoons and crowds of other base laws: which law ranks first, and which effects are named.

The worlds are platoons of laws of the literature (:mod:`benchmarks.synthetic_cases.laws`), and
scenes that SUMO and JuPedSim simulate. The right answers were written down before anything was
run. The diagnosis of the best-fitting law is scored.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pandas as pd

from benchmarks.config import DiscoveryBenchmarkOptions
from benchmarks.discovery.tables import share
from benchmarks.synthetic_cases.laws import FIRST_ORDER, RANGES, measured
from nnode.pages.page import Block, Heading, TableBlock

#: An agent-specific time gap, as measured at the start or as estimated, is one effect.
SAME = {"lasting_time_gap": "driver_heterogeneity"}
#: Effects of a law of second order that a law of the first or of the second order lacks: those of
#: its linearisation (speed difference, lag, a gap that grows with the speed ahead, a highest
#: speed), and how strongly, how evenly and how late drivers respond to speeds.
_RESPONSE = ("relative_speed", "asymmetric_response", "inertia", "reaction_delay")
LACKING = {"first": (*_RESPONSE, "time_gap", "free_flow_speed"), "second": _RESPONSE}
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

    def judge(self, report: dict[str, Any], nearest: dict[str, Any] | None) -> dict[str, Any]:
        """A row of the table.

        Args:
            report: of the requested law.
            nearest: of the best-fitting law; None if it is the requested one.
        """
        last = report if nearest is None else nearest
        first = (report["laws_again"] or report["laws"])["ranking"][0]["name"]
        names = [self.called(effect) for effect in last["effects"]]
        missing = set(self.right) - set(names)
        false = [name for name in names if name not in (*self.right, *self.allowed)]
        unsure = self.unknown and (bool(names) or last["verdict"] == "unknown")
        return {
            "first": first,
            "law_right": first in self.first if self.first else None,
            "verdict": last["verdict"],
            "names": names,
            "leads": [effect["name"] for effect in last["leads"]],
            "right": not false and (not missing or unsure),
            "false": false,
            "asked_verdict": report["verdict"],
            "asked_names": [effect["name"] for effect in report["effects"]],
        }

    def called(self, effect: dict[str, Any]) -> str:
        """The effect's name, or the right name among its equals."""
        names = [effect["name"], *(other["name"] for other in effect["alternatives"])]
        names = [SAME.get(name, name) for name in names]
        return next((name for name in names if name in (*self.right, *self.allowed)), names[0])


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
            asked = ("lin", "idm")[i % 2] if kind == "laws" else ""
            key = f"{kind}-{scene}-s{first + i}"
            found[key] = {"program": kind, "scene": scene, "seed": first + i, "asked": asked}
    return found


def evaluate(program: str, scene: str, seed: int, asked: str = "") -> dict[str, Any]:
    """One world, diagnosed; plain JSON.

    Args:
        asked: the requested law, if ``program`` is ``laws``.
    """
    from nnode.app.discover import diagnose_table
    from nnode.discover.options import DiscoverOptions

    options, walls = DiscoverOptions(page=False, replay=False), None
    with TemporaryDirectory() as folder:
        if program == "laws":
            table, domain, model = measured(scene, seed)[0], "traffic", asked
        else:
            name, domain, model = PROGRAMS[program]
            table, known = import_module(name).recorded(scene, seed)
            if known is not None:
                walls = Path(folder) / "walls.csv"
                known.to_csv(walls, index=False)
        start = time.monotonic()
        found = diagnose_table(table, domain, seed=seed, options=options, model=model, walls=walls)
    report, nearest = found.plain(), None if found.nearest is None else found.nearest.plain()
    row = {"program": program, "scene": scene, "seed": seed, "seconds": time.monotonic() - start}
    if program != "laws":
        answer = import_module(name).SCENES[scene].answer
        return {**row, **answer.judge(report, nearest)}
    ranking = (report["laws_again"] or report["laws"])["ranking"]
    answer = Answer(first=(scene,), allowed=allowed(scene, ranking[0]["name"]))
    judged = answer.judge(report, nearest)
    false = [name for name in judged["asked_names"] if name not in allowed(scene, asked)]
    true: dict[str, Any] = next((law for law in ranking if law["name"] == scene), {})
    ranks = {"behind": true.get("behind"), "p": true.get("p_value")}
    return {**row, "asked": asked, **judged, "asked_false": false, **ranks}


def blocks(rows: list[dict[str, Any]]) -> list[Block]:
    """Shares of right answers by program, and every world."""
    return [
        Heading("Worlds of other laws"),
        TableBlock("worlds_criteria", criteria(rows), "Required: 90 %, 85 %, at most 5 %."),
        TableBlock("worlds", pd.DataFrame(rows), "Every world."),
    ]


def criteria(rows: list[dict[str, Any]]) -> pd.DataFrame:
    """By program: how often the true law ranks first, and how often answers are right or false.

    False names are counted over all diagnoses of laws, and over those of the best-fitting law in
    scenes.
    """
    lines = []
    for program, part in pd.DataFrame(rows).groupby("program", sort=False):
        ranked, false = part["law_right"].dropna(), part["false"].map(bool)
        if program == "laws":
            others = part.loc[part["first"] != part["asked"], "asked_false"]
            false = pd.concat([false, others.map(bool)])
        shares = {
            "right law ranks first": ranked,
            "right answer": part["right"],
            "false name": false,
        }
        lines.append({"program": program, **{name: share(which) for name, which in shares.items()}})
    return pd.DataFrame(lines)
