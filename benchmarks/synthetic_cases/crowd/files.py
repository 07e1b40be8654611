"""A case of crowds as files: the table that a diagnosis reads, and the truth that it does not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.synthetic_cases.case import TABLE, WALLS, Case
from benchmarks.synthetic_cases.crowd.case import CrowdCase
from benchmarks.synthetic_cases.crowd.catalogue import CATALOGUE, NEEDS_EXCITATION, OUTSIDE
from benchmarks.synthetic_cases.faults import Fault, insert
from benchmarks.synthetic_cases.truth import agents_of, clock_of, table, write_truth
from nnode.files import write_text


def write_crowd(case: Case, folder: Path) -> dict[str, Any]:
    """Write ``trajectories.csv``, ``walls.csv`` and ``truth.json``; returns the truth.

    Raises:
        ConfigError: the case hides what crowds do not know.
    """
    made = CrowdCase(case)
    scene, base = made.scene, made.scene.base
    x = made.measured(made.simulate(made.truth)[0])
    faults: list[Fault] = []
    if case.arm == "fault":
        x, faults = insert(case, x)
    agents, clock = agents_of(case, "p"), clock_of(case, scene.clocks)
    heads = np.array(case.runs)[:, None]
    group = np.char.add(heads, np.char.add("g", scene.group.astype(str)))
    columns = {
        "x": np.round(x[..., 0], 5),
        "y": np.round(x[..., 1], 5),
        "group": np.where(scene.group < 0, "", group),
        "dest_x": np.round(scene.goal[..., 0], 4),
        "dest_y": np.round(scene.goal[..., 1], 4),
    }
    write_text(folder / TABLE, table(case, clock, agents, columns))
    walls = pd.DataFrame(scene.segments, columns=["x1", "y1", "x2", "y2"])
    write_text(folder / WALLS, str(walls.to_csv(index=False)))
    return write_truth(
        folder,
        case,
        catalogue=CATALOGUE,
        outside=OUTSIDE,
        effects=made.truth.effects,
        model={"name": "sf", "options": {"B": base.B, "r": base.r, "tau": base.tau}},
        base={"A": base.A, "k": base.k, "kappa": base.kappa},
        noise={
            "amplitude": made.truth.amplitude,
            "unit": "m/s²",
            "correlation": scene.correlation,
        },
        amplitude=made.amplitude,
        costs=made.costs(made.truth) if case.effects else None,
        faults=faults,
        agents=agents,
        clock=clock,
        not_testable=NEEDS_EXCITATION,
        eta=np.round(scene.eta, 6).tolist() if made.truth.eta else [],
    )
