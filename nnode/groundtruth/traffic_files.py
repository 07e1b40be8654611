"""A case of traffic as files: the table that a diagnosis reads, and the truth that it does not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from nnode.files import write_json, write_text
from nnode.groundtruth.case import TABLE, TRUTH, Case
from nnode.groundtruth.faults import Fault, insert
from nnode.groundtruth.traffic import TrafficCase
from nnode.groundtruth.traffic_catalogue import CATALOGUE, NEEDS_EXCITATION, described


def write_traffic(case: Case, folder: Path) -> dict[str, Any]:
    """Write ``trajectories.csv`` and ``truth.json``; returns the truth.

    Raises:
        ConfigError: the case is not one of traffic, or hides what traffic does not know.
    """
    made = TrafficCase(case)
    motion = made.simulate(made.truth)
    x = made.measured(motion)
    faults: list[Fault] = []
    if case.arm == "fault":
        x, faults = insert(case, x)
    names = case.names
    agents = [[f"s{s:03d}v{i}" for i in range(case.n_agents)] for s in range(case.n_sequences)]
    clock = np.round(made.road.around.clocks[:, None] + case.dt * np.arange(case.n_steps + 1), 6)
    write_text(folder / TABLE, _table(made, x, clock, agents))

    around, costs = made.road.around, made.costs(made.truth)
    effects = made.truth.effects
    nuisance = [name for name in effects if name not in case.effects]
    shown = [described(name, effects[name]) for name in case.effects]
    truth = {
        "case": case.to_dict(),
        "key": case.key,
        "model": {
            "name": around.law,
            "leader": "constant" if "leader_speed" in case.effects else "measured",
            "options": {},
        },
        "base": {"v0": around.v0, "L": around.L},
        "recalibrated": costs.recalibrated,
        "effects": [item for item in shown if item["name"] in CATALOGUE],
        "outside": [item for item in shown if item["name"] not in CATALOGUE],
        "nuisance": [described(name, effects[name]) for name in nuisance],
        "edge": made.truth.edge,
        "not_testable": list(NEEDS_EXCITATION) if case.arm == "no_excitation" else [],
        "data_faults": [fault.to_dict(names, agents, clock) for fault in faults],
        "noise": {
            "measurement": case.sigma,
            "amplitude": made.truth.amplitude,
            "unit": "m/s",
            "correlation": made.road.correlation,
        },
        "strength": {
            "share": made.amplitude.share,
            "reached": costs.share,
            "misfit": made.amplitude.misfit,
            "spread": made.amplitude.spread,
            "alone": made.amplitude.alone,
        },
        "cost": {
            "unit": "m²",
            "floor": costs.floor,
            "base": dict(zip(names, costs.base.tolist(), strict=True)),
            "oracle": dict(zip(names, costs.oracle.tolist(), strict=True)),
        },
    }
    write_json(folder / TRUTH, truth)
    return truth


def _table(made: TrafficCase, x: np.ndarray, clock: np.ndarray, agents: list[list[str]]) -> str:
    """The tidy table as CSV, one row per sequence, time and vehicle."""
    _, samples, vehicles = x.shape
    number = [name.split("/")[1] for name in made.case.names]
    kind = np.where(made.road.truck, "truck", "car")
    frame = pd.DataFrame(
        {
            "sequence": np.repeat(number, samples * vehicles),
            "time": np.repeat(clock.ravel(), vehicles),
            "agent": np.repeat(np.array(agents)[:, None], samples, axis=1).ravel(),
            "x": np.round(x.ravel(), 4),
            "length": np.repeat(np.round(made.road.length, 2)[:, None], samples, axis=1).ravel(),
            "kind": np.repeat(kind[:, None], samples, axis=1).ravel(),
        }
    )
    return str(frame.to_csv(index=False))
