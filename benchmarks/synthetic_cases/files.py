"""A case as files: the table that a diagnosis reads, and the truth that it does not."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.synthetic_cases.case import TABLE, TRUTH, WALLS, Case
from benchmarks.synthetic_cases.faults import Fault, insert
from benchmarks.synthetic_cases.strength import Subject
from nnode.files import write_json, write_text


def write(subject: Subject, folder: Path) -> dict[str, Any]:
    """Write ``trajectories.csv``, ``truth.json`` and, if there are walls, ``walls.csv``.

    Returns:
        The content of ``truth.json``.
    """
    case, truth = subject.case, subject.truth
    x = subject.measured(truth)
    faults: list[Fault] = []
    if case.arm == "fault":
        x, faults = insert(case, x)
    letter = "v" if case.domain == "traffic" else "p"
    # no agent is in two runs, and windows of a run share their agents
    agents = [[f"{run}{letter}{i}" for i in range(case.n_agents)] for run in case.runs]
    clock = subject.clocks[:, None] + case.dt * np.arange(case.n_steps + 1)
    clock = np.asarray(np.round(clock, 6))
    write_text(folder / TABLE, _table(case, clock, agents, subject.columns(x)))
    if len(subject.walls):
        walls = pd.DataFrame(subject.walls, columns=["x1", "y1", "x2", "y2"])
        write_text(folder / WALLS, str(walls.to_csv(index=False)))
    names, catalogue = case.names, subject.catalogue
    outside = {name for name in case.effects if name not in catalogue.CATALOGUE}
    costs = subject.costs(truth) if case.effects else None

    def described(chosen: list[str]) -> list[dict[str, Any]]:
        return [_described(name, catalogue.EFFECTS[name], truth.effects[name]) for name in chosen]

    content = {
        "case": case.to_dict(),
        "key": case.key,
        **subject.base(),
        "effects": described([n for n in case.effects if n not in outside]),
        "outside": described([n for n in case.effects if n in outside]),
        "nuisance": described([n for n in truth.effects if n not in case.effects]),
        "data_faults": [fault.to_dict(names, agents, clock) for fault in faults],
        "noise": {
            "measurement": case.sigma,
            "amplitude": truth.amplitude,
            "unit": subject.unit,
            "correlation": subject.correlation,
        },
        "strength": {
            "share": subject.amplitude.share,
            "reached": costs.share if costs is not None else None,
            "misfit": subject.amplitude.misfit,
            "spread": subject.amplitude.spread,
            "alone": subject.amplitude.alone,
        },
        "cost": None
        if costs is None
        else {
            "unit": "m²",
            "floor": costs.floor,
            "base": dict(zip(names, costs.base.tolist(), strict=True)),
            "oracle": dict(zip(names, costs.oracle.tolist(), strict=True)),
        },
    }
    write_json(folder / TRUTH, content)
    return content


def _described(name: str, effect: Any, values: Mapping[str, float]) -> dict[str, Any]:
    """An effect with formula, coefficients and units."""
    coefficients = {k: {"value": v, "unit": effect.units[k]} for k, v in values.items()}
    return {"name": name, "formula": effect.formula, "coefficients": coefficients}


def _table(
    case: Case, clock: np.ndarray, agents: list[list[str]], columns: dict[str, np.ndarray]
) -> str:
    """A tidy table as CSV, one row per sequence, time and agent.

    Args:
        clock: ``(S, K + 1)`` s.
        agents: N names by run.
        columns: ``(S, K + 1, N)`` or, where they do not change, ``(S, N)``.
    """
    shape = (*clock.shape, case.n_agents)
    whole = {"time": clock[:, :, None], "agent": np.array(agents), **columns}
    spread = {
        name: np.broadcast_to(value if value.ndim == 3 else value[:, None], shape)
        for name, value in whole.items()
    }
    frames = []
    for window in case.windows():
        place = window.run, window.samples, window.agents
        values = {name: value[place].ravel() for name, value in spread.items()}
        frames.append(pd.DataFrame({"sequence": window.name, **values}))
    return str(pd.concat(frames).to_csv(index=False))
