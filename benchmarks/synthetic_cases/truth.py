"""What was hidden, as plain JSON: the file that a diagnosis never sees."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pandas as pd

from benchmarks.synthetic_cases.case import TRUTH, Case
from benchmarks.synthetic_cases.faults import Fault
from benchmarks.synthetic_cases.strength import Amplitude, Costs
from nnode.files import write_json


class Described(Protocol):
    """An effect of a catalogue."""

    @property
    def formula(self) -> str: ...

    @property
    def units(self) -> dict[str, str]: ...


def described(
    names: list[str], catalogue: Mapping[str, Described], effects: dict[str, dict[str, float]]
) -> list[dict[str, Any]]:
    """Effects with formula, coefficients and units."""
    return [
        {
            "name": name,
            "formula": catalogue[name].formula,
            "coefficients": {
                key: {"value": value, "unit": catalogue[name].units[key]}
                for key, value in effects[name].items()
            },
        }
        for name in names
    ]


def write_truth(
    folder: Path,
    case: Case,
    *,
    catalogue: Mapping[str, Described],
    outside: Mapping[str, Described],
    effects: dict[str, dict[str, float]],
    model: dict[str, Any],
    base: dict[str, float],
    noise: dict[str, Any],
    amplitude: Amplitude,
    costs: Costs | None,
    faults: list[Fault],
    agents: list[list[str]],
    clock: np.ndarray,
    not_testable: tuple[str, ...],
    **more: Any,
) -> dict[str, Any]:
    """Write ``truth.json``; returns what it holds.

    Args:
        catalogue, outside: effects by name.
        effects: coefficients of all that acts.
        model: what the diagnosis has to be told of the base model.
        base: the base model's true parameters.
        noise: of drivers or walkers.
        amplitude, costs: how strength was set, and what it came to; None where nothing is hidden.
        agents: names by run.
        clock: ``(S, K + 1)`` s.
        not_testable: what data without excitation cannot show.
        more: further keys.
    """
    names = case.names
    nuisance = [name for name in effects if name not in case.effects]
    truth = {
        "case": case.to_dict(),
        "key": case.key,
        "model": model,
        "base": base,
        "recalibrated": None if costs is None else costs.recalibrated,
        "effects": described([n for n in case.effects if n in catalogue], catalogue, effects),
        "outside": described([n for n in case.effects if n in outside], outside, effects),
        "nuisance": described(nuisance, catalogue, effects),
        "not_testable": list(not_testable) if case.arm == "no_excitation" else [],
        "data_faults": [fault.to_dict(names, agents, clock) for fault in faults],
        "noise": {"measurement": case.sigma, **noise},
        "strength": {
            "share": amplitude.share,
            "reached": costs.share if costs is not None and case.effects else None,
            "misfit": amplitude.misfit,
            "spread": amplitude.spread,
            "alone": amplitude.alone,
        },
        "cost": None
        if costs is None
        else {
            "unit": "m²",
            "floor": costs.floor,
            "base": dict(zip(names, costs.base.tolist(), strict=True)),
            "oracle": dict(zip(names, costs.oracle.tolist(), strict=True)),
        },
        **more,
    }
    write_json(folder / TRUTH, truth)
    return truth


def table(
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
    frames = [
        pd.DataFrame(
            {
                "sequence": window.name,
                **{
                    k: v[window.run, window.samples, window.agents].ravel()
                    for k, v in spread.items()
                },
            }
        )
        for window in case.windows()
    ]
    return str(pd.concat(frames).to_csv(index=False))


def clock_of(case: Case, starts: np.ndarray) -> np.ndarray:
    """``(S, K + 1)`` times of the samples, s."""
    return np.asarray(np.round(starts[:, None] + case.dt * np.arange(case.n_steps + 1), 6))


def agents_of(case: Case, letter: str) -> list[list[str]]:
    """Names of the agents by run: no agent is in two runs, and windows of a run share theirs."""
    return [[f"{run}{letter}{i}" for i in range(case.n_agents)] for run in case.runs]
