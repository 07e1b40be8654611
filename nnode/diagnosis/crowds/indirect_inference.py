"""Bias correction of a crowd's calibration by indirect inference.

People are simulated among the measured paths of the others. But the others have reacted to the
person's actual path, including disturbances, and the starts of windows are smoothed. Both bias the
coefficients slightly. The bias is estimated by simulation: the calibrated crowd is simulated with
all interactions, with the disturbances and measurement errors of the data, and calibrated again.

Source: Gouriéroux, Monfort & Renault 1993 (indirect inference); Wu 1986 (signs of residuals).
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Sequence as Many
from dataclasses import replace

import numpy as np
import torch

from nnode.calibrate.parameters import ParameterVector, with_parameters
from nnode.data.sequence import Batch, Sequence, collate
from nnode.diagnosis.crowds.engine import CrowdEngine
from nnode.diagnosis.crowds.paths import Path, Smoother
from nnode.diagnosis.residuals.fit import ROUGH, Fit, refine
from nnode.errors import SimulationError
from nnode.model.system import Crowd, System
from nnode.simulation.numpy import simulated

log = logging.getLogger(__name__)

#: Number of simulated crowds, and simulation steps per sampling interval.
CROWDS, STEPS = 3, 2


def bias_corrected(fit: Fit, sequences: Many[Sequence], seed: int = 0) -> Fit:
    """A calibrated model, corrected for its bias, with the standard errors of the correction.

    Simulations that diverge are ignored; with fewer than two others, the fit is returned unchanged.
    Residuals and derivatives remain those of the calibration.

    Args:
        fit: in the residuals of a :class:`CrowdEngine` of the sequences.
        sequences: that it was calibrated to.
        seed: of signs and errors.
    """
    smoother = Smoother(sequences)
    paths = [smoother.path(s, s.dt * np.arange(s.n_samples)) for s in sequences]
    batch = collate(replace(s, x=p.x, v=p.v) for s, p in zip(sequences, paths, strict=True))
    disturbed = _disturbances(fit.system, batch, paths)
    rng = np.random.default_rng(seed)
    estimates = []
    for _ in range(CROWDS):
        kicks = [kick * rng.choice([-1.0, 1.0], (1, kick.shape[1], 1)) for kick in disturbed]
        simulated_paths = _simulated(fit.system, batch, kicks)
        measured = [
            replace(s, x=x + rng.normal(0.0, np.sqrt(smoother.variance), x.shape), v=None)
            for s, x in zip(sequences, simulated_paths, strict=True)
        ]
        try:
            engine, system = CrowdEngine(measured), copy.deepcopy(fit.system)
            engine.fit_whitening(system, ParameterVector(system).row)
            estimates.append(refine(engine, system, tolerance=ROUGH / 10).row)
        except SimulationError:
            log.debug("a simulated crowd could not be calibrated")
    if len(estimates) < 2:
        return fit
    bias = np.where(fit.free, np.mean(estimates, 0) - fit.row, 0.0)
    row = np.clip(fit.row - bias, *ParameterVector(fit.system).bounds)
    error = np.where(fit.free, np.std(estimates, 0, ddof=1) / np.sqrt(len(estimates)), 0.0)
    system = with_parameters(fit.system, row)
    return replace(fit, system=system, row=row, simulated=error)


@torch.no_grad()
def _disturbances(system: System, batch: Batch, paths: list[Path]) -> list[np.ndarray]:
    """``(K, N, 2)`` accelerations of the measured people that the model does not explain, m/s²."""
    among_measured = _with(system, "measured")
    scene = among_measured.scene(batch)
    time = batch.dt * torch.arange(batch.n_samples, dtype=torch.float64)
    states = torch.cat([batch.x, batch.v], -1)
    explained = torch.stack(
        [among_measured(t, y, scene)[..., 2:4] for t, y in zip(time, states, strict=True)]
    )
    return [
        path.a - explained[: len(path.x), b, : path.x.shape[1]].numpy()
        for b, path in enumerate(paths)
    ]


@torch.no_grad()
def _simulated(system: System, batch: Batch, kicks: list[np.ndarray]) -> list[np.ndarray]:
    """``(K, N, 2)`` positions of each sequence's people with all interactions, m."""
    interacting = _with(system, "simulated")
    scene, y = interacting.scene(batch), interacting.initial(batch)
    push = torch.zeros(batch.n_samples, *y.shape, dtype=torch.float64)
    for b, kick in enumerate(kicks):
        push[: len(kick), b, : kick.shape[1], 2:4] = torch.from_numpy(kick)

    def rate(t: float, y: np.ndarray) -> np.ndarray:
        k = min(int(t / batch.dt + 1e-6), batch.n_samples - 2)
        kick = torch.lerp(push[k], push[k + 1], t / batch.dt - k)
        time = torch.tensor(t, dtype=torch.float64)
        return (interacting(time, torch.from_numpy(y), scene) + kick).numpy()

    states = simulated(rate, y.numpy(), batch.dt, batch.n_samples, batch.dt / STEPS)
    return [states[: len(kick), b, : kick.shape[1], :2] for b, kick in enumerate(kicks)]


def _with(system: System, neighbours: str) -> Crowd:
    crowd = copy.deepcopy(system)
    assert isinstance(crowd, Crowd)
    crowd.neighbours = neighbours
    return crowd
