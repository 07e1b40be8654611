"""Whether the advised measurements distinguish a reaction delay from inertia.

Drivers react late, or slowly, to the gap. If the diagnosis of forty platoons cannot tell which, as
many platoons as it asks for follow the advised leader, and as many follow random leaders, for the
same time. Both are diagnosed together with the first platoons.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.config import DiscoveryBenchmarkOptions
from benchmarks.synthetic_cases.platoons import DT, SUBSTEPS, platoons, waves
from benchmarks.synthetic_cases.score import EQUALS, judged
from benchmarks.synthetic_cases.traffic.motion import Hidden
from nnode.data.sequence import Sequence
from nnode.diagnosis.options import DiscoverOptions
from nnode.diagnosis.single_law import diagnose_law
from nnode.model.build import build_model

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


def evaluate(seed: int, name: str) -> dict[str, list[dict[str, Any]]]:
    """Rows of the first diagnosis, and of the later ones."""
    rng = np.random.default_rng([seed, list(EFFECTS).index(name)])
    value, v0, L = (float(rng.uniform(*ends)) for ends in ((0.4, 0.8), (26, 32), (5, 7)))
    options = DiscoverOptions(effects=list(EFFECTS), structure=False, compare=[])
    law = {"term": "lin", "name": "lin", "leader": "measured", "v0": 28.0, "L": 6.0, "L_min": 1.0}

    def measured(speed: np.ndarray) -> np.ndarray:
        hidden = Hidden(**{EFFECTS[name]: value})
        noise = {"push": 0.3, "correlation": 3.0, "error": 0.05}
        return platoons(rng, speed, v0, L, hidden, vehicles=5, before=BEFORE, **noise)

    rows: list[dict[str, Any]] = []

    def diagnosed(data: str, runs: np.ndarray) -> dict[str, Any]:
        time = DT * np.arange(runs.shape[1])
        sequences = [
            Sequence(name=f"r/{i}", recording="r", time=time + 100.0 * i, x=x[..., None])
            for i, x in enumerate(runs)
        ]
        report = diagnose_law(build_model(law), sequences, options).diagnosis.plain()
        row = {"data": data, "seed": seed, "hidden": name, "value": value}
        rows.append(row | judged(report, [name]))
        return report

    first = measured(waves(rng, FIRST, BEFORE + SECONDS, 16.0))
    report = diagnosed("first", first)
    rivals = [rival for effect in report["effects"] for rival in effect["alternatives"]]
    profiles = [rival["profile"] for rival in rivals if rival["profile"] is not None]
    if report["verdict"] == EQUALS and profiles:
        profile = profiles[0]
        # the advice counts exploration platoons
        number = min(round(profile["platoons"] / (1 - options.confirmation)), MOST)
        random = waves(rng, number, BEFORE + SECONDS, 16.0)
        clock = np.maximum(0.5 * DT / SUBSTEPS * np.arange(random.shape[1]) - BEFORE, 0.0)
        swing = np.sin(2 * np.pi * clock / profile["period"])
        advised = np.repeat(profile["mean"] + profile["swing"] * swing[None], number, 0)
        for data, speed in (("advised", advised), ("random", random)):
            diagnosed(data, np.concatenate([first, measured(speed)]))
    return {"advice": rows}
