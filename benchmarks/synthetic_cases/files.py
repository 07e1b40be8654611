"""A case as files: the table that a diagnosis reads, and the truth that it does not."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.synthetic_cases.case import TABLE, TRUTH, WALLS, Case
from benchmarks.synthetic_cases.catalogue import CATALOGUES
from benchmarks.synthetic_cases.faults import insert
from benchmarks.synthetic_cases.subject import Subject
from nnode.files import write_json, write_text


def write(subject: Subject, folder: Path) -> dict[str, Any]:
    """Write ``trajectories.csv``, ``truth.json`` and, if there are walls, ``walls.csv``.

    Returns:
        The content of ``truth.json``.
    """
    case, truth = subject.case, subject.truth
    letter = "v" if case.domain == "traffic" else "p"
    # no agent is in two runs, and windows of a run share their agents
    agents = [[f"{run}{letter}{i}" for i in range(case.size[0])] for run in case.runs]
    clock = subject.clocks[:, None] + case.size[2] * np.arange(case.n_steps + 1)
    clock = np.asarray(np.round(clock, 6))
    x = subject.measured()
    faults: list[dict[str, Any]] = []
    if case.arm == "fault":
        x, faults = insert(case, x, agents, clock)
    write_text(folder / TABLE, _table(case, clock, agents, subject.columns(x)))
    if len(subject.walls):
        walls = pd.DataFrame(subject.walls, columns=["x1", "y1", "x2", "y2"])
        write_text(folder / WALLS, str(walls.to_csv(index=False)))
    catalogue = CATALOGUES[case.domain]
    costs = subject.costs(truth) if case.effects else None

    def described(names: Iterable[str]) -> list[dict[str, Any]]:
        return [
            {
                "name": name,
                "formula": (effect := catalogue.effects[name]).formula,
                "coefficients": {
                    key: {"value": value, "unit": effect.coefficients[key]["unit"]}
                    for key, value in truth.effects[name].items()
                },
            }
            for name in names
        ]

    content: dict[str, Any] = {
        "case": case.to_dict(),
        "key": case.key,
        "model": subject.model,
        "base": subject.base,
        **({"edge": truth.smooth} if case.domain == "traffic" else {}),
        "effects": described(n for n in case.effects if n in catalogue.named),
        "outside": described(n for n in case.effects if n not in catalogue.named),
        "nuisance": described(n for n in truth.effects if n not in case.effects),
        "data_faults": faults,
        "noise": {
            "measurement": case.sigma,
            "amplitude": truth.amplitude,
            "unit": subject.unit,
            "correlation": subject.correlation,
        },
        "strength": subject.strength,
        "cost": None,
    }
    if costs is not None:
        content["strength"]["reached"] = costs.share
        content["cost"] = {
            "unit": "m²",
            "floor": costs.floor,
            "base": dict(zip(case.names, costs.base.tolist(), strict=True)),
            "oracle": dict(zip(case.names, costs.oracle.tolist(), strict=True)),
        }
    write_json(folder / TRUTH, content)
    return content


def _table(
    case: Case, clock: np.ndarray, agents: list[list[str]], columns: dict[str, np.ndarray]
) -> str:
    """A tidy table as CSV, one row per sequence, time and agent.

    Args:
        clock: ``(S, K + 1)`` s.
        agents: N names by run.
        columns: ``(S, K + 1, N)`` or, where they do not change, ``(S, N)``.
    """
    shape = (*clock.shape, case.size[0])
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
