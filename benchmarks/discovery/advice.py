"""Whether the advised measurements distinguish a reaction delay from inertia.

Drivers react late, or slowly, to the gap. If the diagnosis of forty platoons cannot tell which, as
many platoons as it asks for follow the advised leader, and as many follow random leaders, for the
same time. Both are diagnosed together with the first platoons.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from benchmarks.config import DiscoveryBenchmarkOptions
from benchmarks.discovery.tables import share
from benchmarks.synthetic_cases.platoons import DT, SUBSTEPS, platoons, waves
from benchmarks.synthetic_cases.traffic.motion import Hidden
from nnode.pages.page import Block, Heading, TableBlock

#: Effects, and their coefficients in the equations of motion, s.
EFFECTS = {"reaction_delay": "T", "inertia": "tau_v"}
#: Time before the first sample and recorded time, s; platoons of the first diagnosis, and at most.
BEFORE, SECONDS, FIRST, MOST = 30.0, 30.0, 40, 120


def cases(kind: str, options: DiscoveryBenchmarkOptions, first: int) -> dict[str, Any]:
    """``seeds`` cases of delay and of inertia."""
    return {
        f"advice-{name}-s{seed}": {"seed": seed, "name": name}
        for seed in range(first, first + options.seeds)
        for name in EFFECTS
    }


def evaluate(seed: int, name: str) -> dict[str, Any]:
    """The first verdict, and the later ones."""
    from nnode.data.sequence import Sequence
    from nnode.discover.diagnose import diagnose
    from nnode.discover.options import DiscoverOptions
    from nnode.model.build import build_model

    rng = np.random.default_rng([seed, list(EFFECTS).index(name)])
    value, v0, L = (float(rng.uniform(*ends)) for ends in ((0.4, 0.8), (26, 32), (5, 7)))
    options = DiscoverOptions(effects=list(EFFECTS), structure=False, compare=[])
    law = {"term": "lin", "name": "lin", "leader": "measured", "v0": 28.0, "L": 6.0, "L_min": 1.0}

    def measured(speed: np.ndarray) -> np.ndarray:
        hidden = Hidden(**{EFFECTS[name]: value})
        noise = {"push": 0.3, "correlation": 3.0, "error": 0.05}
        return platoons(rng, speed, v0, L, hidden, vehicles=5, before=BEFORE, **noise)

    def verdict(runs: np.ndarray) -> Any:
        time = DT * np.arange(runs.shape[1])
        sequences = [
            Sequence(name=f"r/{i}", recording="r", time=time + 100.0 * i, x=x[..., None])
            for i, x in enumerate(runs)
        ]
        return diagnose(build_model(law), sequences, options).diagnosis

    first = measured(waves(rng, FIRST, BEFORE + SECONDS, 16.0))
    before = verdict(first)
    row: dict[str, Any] = {"seed": seed, "name": name, "value": value, "verdict": before.verdict}
    row["first"] = [before.verdict, *(effect.name for effect in before.effects)]
    profiles = [o.profile for e in before.effects for o in e.alternatives if o.profile is not None]
    if before.verdict != "indistinguishable" or not profiles:
        return row
    profile = profiles[0]
    # the advice counts exploration platoons
    number = min(round(profile.platoons / (1 - options.sealed)), MOST)
    random = waves(rng, number, BEFORE + SECONDS, 16.0)
    clock = np.maximum(0.5 * DT / SUBSTEPS * np.arange(random.shape[1]) - BEFORE, 0.0)
    advised = profile.mean + profile.swing * np.sin(2 * np.pi * clock / profile.period)
    for how, speed in (("advised", np.repeat(advised[None], number, 0)), ("random", random)):
        later = verdict(np.concatenate([first, measured(speed)]))
        row[how] = [later.verdict, *(effect.name for effect in later.effects)]
    return {**row, "platoons": profile.platoons}


def blocks(rows: list[dict[str, Any]]) -> list[Block]:
    """How often the effects are distinguished, at first, with the advice, and without it."""
    lines = []
    for how in ("first", "advised", "random"):
        part = [row for row in rows if how in row]
        named = pd.Series([row[how][0] == "named" for row in part], dtype=bool)
        right = pd.Series([row[how] == ["named", row["name"]] for row in part], dtype=bool)
        lines.append({"data": how, "right": share(right), "wrong": share(named & ~right)})
    return [
        Heading("Advised measurements"),
        TableBlock("advice", pd.DataFrame(lines), "Cases in which one of two effects is named."),
    ]
