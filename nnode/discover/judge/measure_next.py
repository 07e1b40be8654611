"""What to measure next: how a leader should drive for two effects to be told apart.

Both calibrated models drive the same platoon behind leaders with different profiles of speed. What
one of them cannot imitate of the other's paths by its own parameters, whitened as the residuals
are, tells the two apart: d², the expected rise of the sum of squares. In n platoons the residuals
of the wrong model lean towards the true one by n d² with a standard deviation of d (n f)^½; f is
how far open clusters vary beyond that. So n is f (t_level + t_power)² / d² with Student's quantiles
of n - 1 degrees of freedom, the larger one of both truths, and no less than sign flips of n
platoons need, which may outweigh all others; sealed platoons come beside these.

Source: Box & Hill 1967 (experiments that discriminate between models).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from scipy import stats

from nnode.calibrate.parameters import ParameterVector
from nnode.data.clusters import least_number
from nnode.data.paths import velocity
from nnode.data.sequence import Sequence
from nnode.discover.lanes.engine import TrafficEngine
from nnode.discover.residuals.fit import sums
from nnode.discover.result import Profile
from nnode.errors import SimulationError
from nnode.model.system import System

#: s that a profile lasts after as long a drive at its mean speed, in which starts are forgotten.
LASTS = 30.0
#: m/s² that a leader brakes and accelerates with at most; comfortable: Treiber & Kesting 2013.
COMFORTABLE = 2.0
#: Periods of a leader's speed that are tried, s.
PERIODS = (3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0)
#: Probability of telling two effects apart.
POWER = 0.9


def advised(engine: TrafficEngine, one: System, other: System, level: float) -> Profile | None:
    """The profile of those that are tried which takes the fewest platoons; None where all runs
    blow up or no number would do.

    Args:
        engine: of the open sequences, settled.
        one, other: models with either effect, calibrated.
        level: at which the two are told apart.
    """
    found = tried(engine, one, other, level)
    return min(found, key=lambda profile: profile.platoons, default=None)


def tried(engine: TrafficEngine, one: System, other: System, level: float) -> Iterator[Profile]:
    """Each profile with its number of platoons; those that no number would do for are left out."""
    excess = _excess(engine, one, other)
    speeds = _leaders(engine)
    low, mean, high = np.quantile(speeds, [0.0, 0.5, 1.0])
    room = min(mean - low, high - mean)
    for period in PERIODS:
        swing = float(min(room, COMFORTABLE * period / (2 * math.pi)))
        away = []
        for truth, wrong in ((one, other), (other, one)):
            try:
                away.append(distance(engine, truth, wrong, mean, swing, period))
            except SimulationError:
                away.append(0.0)
        least = min(away)
        if least > 0 and math.isfinite(least):
            number = _platoons(excess / least, level)
            yield Profile(float(mean), swing, period, LASTS, number)


def _platoons(ratio: float, level: float) -> int:
    """The least n of at least ratio times the square of the sum of Student's quantiles."""
    least = ratio * stats.norm.ppf([1 - level, POWER]).sum() ** 2
    number = max(least_number(level, sided=1), math.ceil(least))
    while number < ratio * stats.t.ppf([1 - level, POWER], number - 1).sum() ** 2:
        number += 1
    return number


def distance(
    engine: TrafficEngine, truth: System, wrong: System, mean: float, swing: float, period: float
) -> float:
    """d² of one platoon: the squared whitened deviations of one model from another one's paths that
    the former's own parameters cannot take out."""
    dt = engine.batch.dt
    time = dt * np.arange(round(2 * LASTS / dt) + 1)
    later = np.maximum(time - LASTS, 0.0)
    angle = 2 * math.pi / period
    place = mean * time + swing / angle * (1 - np.cos(angle * later))
    template = max(engine.sequences, key=lambda sequence: sequence.n_agents)
    gaps = np.diff(np.median(template.x[..., 0], axis=0))
    start = np.concatenate([-np.cumsum(gaps[::-1])[::-1], [0.0]])
    paths = _driven(truth, _platoon(template, time, place[:, None] + start))
    kept = time >= LASTS - dt / 2
    found = engine.of([_platoon(template, time[kept], paths[kept])])
    row = ParameterVector(wrong).row
    residual = found.residuals(wrong, row[None])[0].numpy()
    columns = found.tangents(wrong, row).numpy().T
    if not (np.isfinite(residual).all() and np.isfinite(columns).all()):
        raise SimulationError("the models blow up behind such a leader")
    rest = residual - columns @ np.linalg.lstsq(columns, residual, rcond=None)[0]
    return float(rest @ rest)


def _driven(system: System, platoon: Sequence) -> np.ndarray:
    """``(K, N)`` paths behind the leader of a platoon, from its starts, m."""
    x = platoon.x[..., 0]
    found = TrafficEngine([platoon], np.inf, None, np.inf)
    with torch.no_grad():
        states = found.simulate(system, ParameterVector(system).row[None])[0]
    leader = np.arange(x.shape[1]) == x.shape[1] - 1
    return np.where(leader, x, states[:, 0, : x.shape[1], 0].numpy())


def _platoon(template: Sequence, time: np.ndarray, x: np.ndarray) -> Sequence:
    """The template's vehicles on other paths ``(K, N)``."""
    v = velocity(x[..., None], float(time[1] - time[0]))
    return replace(template, name="advised", time=time, x=x[..., None], v=v, agents=())


def _leaders(engine: TrafficEngine) -> np.ndarray:
    """Measured leaders' speeds, m/s."""
    return np.concatenate([s.velocity()[:, -1, 0] for s in engine.sequences])


def _excess(engine: TrafficEngine, one: System, other: System) -> float:
    """How far clusters' residuals lean beyond what independent ones do."""
    rows = {s: ParameterVector(s).row[None] for s in (one, other)}
    first, second = (engine.residuals(s, row)[0].numpy() for s, row in rows.items())
    lean = sums(first * (first - second), engine.cluster)
    expected = float(((first - second) ** 2).sum())
    if len(lean) < 2 or not expected > 0:
        return 1.0
    return max(1.0, len(lean) * float(lean.var(ddof=1)) / expected)
