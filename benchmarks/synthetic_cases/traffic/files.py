"""A case of traffic as files: the table that a diagnosis reads, and the truth that it does not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.synthetic_cases.case import TABLE, Case
from benchmarks.synthetic_cases.faults import Fault, insert
from benchmarks.synthetic_cases.traffic.case import TrafficCase
from benchmarks.synthetic_cases.traffic.catalogue import CATALOGUE, NEEDS_EXCITATION, OUTSIDE
from benchmarks.synthetic_cases.truth import agents_of, clock_of, table, write_truth
from nnode.files import write_text


def write_traffic(case: Case, folder: Path) -> dict[str, Any]:
    """Write ``trajectories.csv`` and ``truth.json``; returns the truth.

    Raises:
        ConfigError: the case hides what traffic does not know.
    """
    made = TrafficCase(case)
    road, around = made.road, made.road.around
    x = made.measured(made.simulate(made.truth))
    faults: list[Fault] = []
    if case.arm == "fault":
        x, faults = insert(case, x)
    agents, clock = agents_of(case, "v"), clock_of(case, around.clocks)
    columns = {
        "x": np.round(x, 4),
        "length": np.round(road.length, 2),
        "kind": np.where(road.truck, "truck", "car"),
    }
    write_text(folder / TABLE, table(case, clock, agents, columns))
    leader = "constant" if "leader_speed" in case.effects else "measured"
    return write_truth(
        folder,
        case,
        catalogue=CATALOGUE,
        outside=OUTSIDE,
        effects=made.truth.effects,
        model={"name": around.law, "leader": leader, "options": {}},
        base={"v0": around.v0, "L": around.L},
        noise={
            "amplitude": made.truth.amplitude,
            "unit": "m/s",
            "correlation": road.correlation,
        },
        amplitude=made.amplitude,
        costs=made.costs(made.truth) if case.effects else None,
        faults=faults,
        agents=agents,
        clock=clock,
        not_testable=NEEDS_EXCITATION,
        edge=made.truth.edge,
    )
