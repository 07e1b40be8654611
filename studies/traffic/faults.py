"""The page's part on faults of the measurement: which sequences make the cost."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import torch

from nnode.pages.page import Block, FigureBlock, Heading, TableBlock, Text
from nnode.simulation.fused import FusedSolver
from studies.traffic.figures import space_time
from studies.traffic.problem import Problem
from studies.traffic.results import AVERAGE, Study, least

#: Sequences named per recording.
NAMED = 3
#: The models whose costs are taken apart.
SHOWN = ("lin", "n4")


def fault_blocks(study: Study) -> list[Block]:
    """The sequences that dominate the costs, one of them drawn, and the costs without faults."""
    table = _dominating(study)
    listed = study.stores["keep"].manifest["faults"]
    faulty = {fault["sequence"] for fault in listed}
    shares = [_share(study, name, "n4", faulty) for name in study.recordings()]
    dropped = study.costs(policy="drop")
    factor = study.costs()[AVERAGE] / dropped[AVERAGE]
    worst = table["share lin (%)"].to_numpy(float).argmax()
    name = str(table.iloc[worst]["sequence"])
    count = len(study.stores["keep"])
    text = (
        f"{len(faulty)} of {count} sequences hold a fault of the measurement (two cars closer than "
        "a car's length, a path that carries on under another car's number, a jump, a car going "
        f"backwards). They make {100 * np.mean(shares):.0f} % of the cost of N4 (mean over "
        f"recordings). Without them costs fall by a factor of {factor.min():.1f} to "
        f"{factor.max():.1f} on average."
    )
    return [
        Heading("Faulty sequences"),
        Text(text),
        TableBlock(
            "dominating_sequences",
            table,
            f"The {NAMED} dearest sequences of each recording under Lin: their share of the "
            "recording's cost, vehicles, start of the sequence and faults found in it.",
            digits={"vehicles": 0, "start (s)": 1, "share lin (%)": 0, "share n4 (%)": 0},
        ),
        _drawn(study, name, listed),
        TableBlock(
            "table_2_dropped",
            dropped,
            "Costs (m² s) with faulty sequences dropped before calibration; least in bold.",
            bold=least(dropped),
        ),
    ]


def _share(study: Study, recording: str, model: str, faulty: set[str]) -> float:
    costs = np.array(study.one("fit", recording, model)["costs"])
    there = np.array([s.name in faulty for s in study.sequences(recording)])
    return float(costs[there].sum() / costs.sum())


def _dominating(study: Study) -> pd.DataFrame:
    kinds: dict[str, set[str]] = {}
    for fault in study.stores["keep"].manifest["faults"]:
        kinds.setdefault(fault["sequence"], set()).add(fault["kind"])
    rows = []
    for number, recording in enumerate(study.recordings(), 1):
        costs = {m: np.array(study.one("fit", recording, m)["costs"]) for m in SHOWN}
        sequences = study.sequences(recording)
        for i in np.argsort(-costs["lin"])[:NAMED]:
            one = sequences[i]
            rows.append(
                {
                    "number": number,
                    "sequence": one.name,
                    "vehicles": one.n_agents,
                    "start (s)": float(one.time[0]),
                    **{f"share {m} (%)": 100 * c[i] / c.sum() for m, c in costs.items()},
                    "faults": ", ".join(sorted(kinds.get(one.name, ()))) or "none found",
                }
            )
    return pd.DataFrame(rows).set_index("number")


def _drawn(study: Study, name: str, faults: list[dict[str, Any]]) -> FigureBlock:
    recording = name.rsplit("/", 1)[0]
    (sequence,) = (s for s in study.sequences(recording) if s.name == name)
    simulated = {}
    for model in SHOWN:
        problem = Problem([sequence], model)
        values = study.one("fit", recording, model)["parameters"]
        system = problem.system()
        with torch.no_grad():
            for key, parameter in system.named_parameters():
                parameter.copy_(torch.tensor(values[key.removeprefix("terms.0.")]))
            found = FusedSolver(study.options.dt)(system, problem.batch.to(dtype=torch.float64))
        simulated[model] = found.x[:, 0, :, 0].numpy()
    marked = [
        (int(agent), float(fault["time"]))
        for fault in faults
        if fault["sequence"] == name and fault["time"] is not None
        for agent in fault["agents"]
    ]
    kinds = sorted({fault["kind"] for fault in faults if fault["sequence"] == name})
    return FigureBlock(
        "dominating_sequence",
        space_time(sequence, simulated, marked),
        f"The sequence with the greatest share of its recording's cost, {name}: measured and "
        f"simulated. Faults found: {', '.join(kinds) or 'none'}. No choice of parameters follows "
        "a position that changes hands."
        if kinds
        else f"The dearest sequence, {name}.",
        f"Position against time of {sequence.n_agents} vehicles, measured and simulated.",
    )
