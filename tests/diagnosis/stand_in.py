"""A diagnosis with made results, to test commands and reports."""

from __future__ import annotations

import os
import time
from copy import deepcopy
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from nnode.data.sequence import Sequence
from nnode.diagnosis.confirmation import defined
from nnode.diagnosis.options import DiscoverOptions
from nnode.diagnosis.outcome import DiagnosisOutcome, Simulation
from nnode.diagnosis.report.deviation import simulate
from nnode.diagnosis.result import (
    Absence,
    Agents,
    Alternative,
    Clusters,
    Coefficient,
    Confirmation,
    Diagnosis,
    FirstScreen,
    Gap,
    NamedEffect,
    Place,
    Structure,
)
from nnode.model import System
from nnode.model.build import add_effects
from nnode.model.effects import CATALOGUE, Effect, Strength
from nnode.model.term import Interval, State
from tests.diagnosis.recorded import ALPHA, PUSH, V0, WIND, ZONE, L

#: A file that the stand-in writes before it waits, so that it can be interrupted.
WAIT = "STAND_IN_WAITS_IN"


@CATALOGUE.add
class Wind(Effect):
    """A constant acceleration."""

    w_x: Tensor
    w_y: Tensor
    name = "made_up_wind"
    domain = "crowd"
    formula = "+ (w_x, w_y)"
    source = "none: made up"
    strengths: ClassVar = {
        "w_x": Strength(0.0, 0.1, Interval(-2.0, 2.0), "m/s²"),
        "w_y": Strength(0.0, 0.1, Interval(-2.0, 2.0), "m/s²"),
    }

    def forward(self, state: State) -> Tensor:
        return torch.stack([self.w_x, self.w_y]).expand_as(state.x)


def diagnose(
    system: System,
    sequences: list[Sequence],
    options: DiscoverOptions,
    *,
    stages: object = None,
    nearer: object = None,
    hint: object = None,
) -> DiagnosisOutcome:
    """Results that fit the data of :mod:`tests.diagnosis.recorded`."""
    if os.environ.get(WAIT):
        Path(os.environ[WAIT]).write_text("")
        time.sleep(60)
    traffic = system.domain == "traffic"
    number = max(1, round(options.confirmation * len(sequences)))
    confirmation = list(range(len(sequences) - number, len(sequences)))
    if traffic:
        name, values = "speed_zone", {"alpha": ALPHA, "a": ZONE[0], "b": ZONE[1]}
    else:
        name, values = "made_up_wind", {"w_x": WIND[0], "w_y": WIND[1]}
    base = calibrated(system)
    extended = deepcopy(base)
    add_effects(extended, [{"name": name, **values}])
    kind = CATALOGUE.effects[name]
    units = {**kind.strengths, **kind.settings}
    effect = NamedEffect(
        name=name,
        formula=kind.formula,
        source=kind.source,
        coefficients={
            key: Coefficient(v, v - 0.02 * abs(v) - 0.01, v + 0.03, units[key].unit)
            for key, v in values.items()
        },
        where=f"x in [{ZONE[0]:g}, {ZONE[1]:g}] m" if traffic else "everywhere",
        alternatives=[Alternative("speed_period", 1.02, 0.3, "platoons at other times")]
        if traffic
        else [],
        p_value=0.001,
        gain=0.63,
        confirmed=0.01,
    )
    simulated = _simulated((base, extended), [sequences[i] for i in confirmation])
    costs = np.array([[_cost(simulation) for simulation in pair] for pair in simulated])
    before, after = costs.mean(0)
    floor = 0.0025 if traffic else 0.0002
    at = np.linspace(0, 1000, 12)
    near = np.exp(-(((at - 500) / 90) ** 2))
    return DiagnosisOutcome(
        diagnosis=Diagnosis(
            verdict="named",
            domain=system.domain,
            model="stand-in",
            clusters=Clusters(
                exploration=len(sequences) - number,
                confirmation=number,
                least_exploration=11,
                least_confirmation=5,
                enough=17,
                why="sequences of a recording that share an agent",
                simultaneous="no two clusters of a recording were there at one time",
            ),
            screen=FirstScreen(
                p_value=0.001,
                effect=name,
                clusters=len(sequences) - number,
                floor=0.001,
                strongest=[
                    {"name": name, "share": 0.5, "p_value": 0.001, next(iter(values)): -0.3}
                ],
            ),
            confirmation=Confirmation(0.01, number, True),
            effects=[effect],
            hypotheses=[],
            drivers=[],
            agents=[drivers()] if traffic else [],
            data_faults=[],
            not_testable=["reaction_delay"] if traffic else [],
            absences=[
                Absence("inertia", True, "tau_v", "s", 0.2, 0.15, ""),
                Absence("vehicle_class", False, "phi", "1", None, None, "no classes are known"),
            ],
            places=[
                Place(
                    variable,
                    unit,
                    400,
                    600,
                    -6.1,
                    0.4,
                    0.71,
                    0.001,
                    {"at": list(at), "deviation": list(-6 * near), "error": list(0.3 + 0 * at)},
                )
                for variable, unit in (("position", "m"), ("gap", "m"), ("clock time", "s"))
            ],
            unknown=Structure(
                ["position", "gap"], 0.07, "0.02 x", {"at": list(at), "deviation": list(near)}
            ),
            gap=Gap(
                before,
                after,
                floor,
                (before - after) / (before - floor),
                definition=defined(system.domain, False),
            ),
            base={"lin.v0": {"before": 24.0, "after": V0, "unit": "m/s"}} if traffic else {},
            split={
                "exploration": [s.name for i, s in enumerate(sequences) if i not in confirmation],
                "confirmation": [sequences[i].name for i in confirmation],
            },
            notes=["made by hand"],
            seconds={"screening": 1.0},
            confirmation_errors=[
                {"name": sequences[i].name, "before": b, "after": a}
                for i, (b, a) in zip(confirmation, costs, strict=True)
            ],
        ),
        base=base,
        extended=extended,
        searched=extended,
        exploration=[i for i in range(len(sequences)) if i not in confirmation],
        confirmation=confirmation,
        simulated=simulated,
    )


def drivers() -> Agents:
    """Differences between drivers, which are not confirmed."""
    return Agents(
        name="driver_heterogeneity",
        strength=0.05,
        low=0.02,
        high=0.07,
        unit="1",
        p_value=0.02,
        lasts=8.0,
        share={"recording": None, "sequence": 0.2, "agent": 0.5, "transient": 0.3},
        lags=[2.0, 4.0, 8.0],
        common=[0.004, 0.003, 0.0025],
        later={"without numbers": 0.31, "own numbers": 0.32, "constant velocity": 0.9},
        confirmed=0.4,
        found=True,
        named=False,
        reason="the last part of the confirmation sequences is not predicted better by own numbers",
    )


@torch.no_grad()
def calibrated(system: System) -> System:
    """A copy with the parameters of the recorded data, without the effect."""
    base = deepcopy(system)
    law, force = base.find_law("lin"), base.find_law("social_force")
    if law is not None:
        law.v0.fill_(V0)
        law.L.fill_(L)
    if force is not None:
        force.A.fill_(PUSH)
        force.k.fill_(0.0)
        force.kappa.fill_(0.0)
    return base


def _simulated(
    systems: tuple[System, System], sequences: list[Sequence]
) -> list[tuple[Simulation | None, Simulation | None]]:
    columns: list[list[Simulation | None]] = []
    for system in systems:
        column: list[Simulation | None] = []
        for x, s in zip(simulate(system, sequences), sequences, strict=True):
            if x is not None and s.x.shape[2] == 1:
                x[:, -1] = np.nan  # the leader is an input
            column.append(None if x is None else Simulation(s, x, skip=1))
        columns.append(column)
    return list(zip(*columns, strict=True))


def _cost(simulation: Simulation | None) -> float:
    if simulation is None:
        return float("nan")
    error = (simulation.x - simulation.sequence.x)[simulation.skip :]
    return float(np.nanmean((error**2).sum(-1)))
