"""Design of the next experiment: the leader's speed profile that distinguishes two effects.

Both calibrated models are simulated in the same platoon behind leaders with different speed
profiles. d² is the squared whitened difference of their paths that the parameters of the wrong
model cannot explain, the expected increase of the sum of squares. In n platoons, the score of the
wrong model toward the true one has the mean n d² and the standard deviation d (n f)^½, where f is
the overdispersion of the exploration clusters. So n is f (t_level + t_power)² / d² with Student's
quantiles of n - 1 degrees of freedom, the larger value of both truths, and at least the number that
sign flips need. Platoons for confirmation are additional.

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
from nnode.data.clusters import group_sums, least_number
from nnode.data.paths import velocity
from nnode.data.sequence import Sequence
from nnode.diagnosis.lanes.engine import TrafficEngine
from nnode.diagnosis.result import Profile
from nnode.errors import SimulationError
from nnode.model.system import System

#: Duration of a profile, s. It follows an equally long drive at its mean speed, in which the
#: influence of the start decays.
LASTS = 30.0
#: Largest acceleration of the leader, m/s²; comfortable: Treiber & Kesting 2013.
COMFORTABLE = 2.0
#: Periods of the leader's speed, s.
PERIODS = (3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0)
#: Power of the test between two effects.
POWER = 0.9


def best_profile(
    engine: TrafficEngine, first: System, second: System, level: float
) -> Profile | None:
    """The profile that needs the fewest platoons; None if all simulations diverge or no number is
    sufficient.

    Args:
        engine: of the exploration sequences, with fitted whitening.
        first, second: calibrated models, each with one of the effects.
        level: of the test between them.
    """
    profiles = evaluated_profiles(engine, first, second, level)
    return min(profiles, key=lambda profile: profile.platoons, default=None)


def evaluated_profiles(
    engine: TrafficEngine, first: System, second: System, level: float
) -> Iterator[Profile]:
    """Each profile with its number of platoons, without those for which no number is sufficient."""
    excess = _excess(engine, first, second)
    speeds = _leaders(engine)
    low, mean, high = np.quantile(speeds, [0.0, 0.5, 1.0])
    amplitude = min(mean - low, high - mean)
    for period in PERIODS:
        swing = float(min(amplitude, COMFORTABLE * period / (2 * math.pi)))
        distances = []
        for truth, wrong in ((first, second), (second, first)):
            try:
                distances.append(distance(engine, truth, wrong, mean, swing, period))
            except SimulationError:
                distances.append(0.0)
        smallest = min(distances)
        if smallest > 0 and math.isfinite(smallest):
            number = _platoons(excess / smallest, level)
            yield Profile(float(mean), swing, period, LASTS, number)


def _platoons(ratio: float, level: float) -> int:
    """The smallest n that is at least ratio times the squared sum of Student's quantiles."""
    lower_bound = ratio * stats.norm.ppf([1 - level, POWER]).sum() ** 2
    number = max(least_number(level, sided=1), math.ceil(lower_bound))
    while number < ratio * stats.t.ppf([1 - level, POWER], number - 1).sum() ** 2:
        number += 1
    return number


def distance(
    engine: TrafficEngine, truth: System, wrong: System, mean: float, swing: float, period: float
) -> float:
    """d² of one platoon: the squared whitened deviations of one model from the paths of another
    that the parameters of the former cannot explain."""
    dt = engine.batch.dt
    time = dt * np.arange(round(2 * LASTS / dt) + 1)
    elapsed = np.maximum(time - LASTS, 0.0)
    angle = 2 * math.pi / period
    place = mean * time + swing / angle * (1 - np.cos(angle * elapsed))
    template = max(engine.sequences, key=lambda sequence: sequence.n_agents)
    gaps = np.diff(np.median(template.x[..., 0], axis=0))
    start = np.concatenate([-np.cumsum(gaps[::-1])[::-1], [0.0]])
    paths = _driven(truth, _platoon(template, time, place[:, None] + start))
    kept = time >= LASTS - dt / 2
    platoon_engine = engine.on_sequences([_platoon(template, time[kept], paths[kept])])
    row = ParameterVector(wrong).row
    residual = platoon_engine.residuals(wrong, row[None])[0].numpy()
    columns = platoon_engine.tangents(wrong, row).numpy().T
    if not (np.isfinite(residual).all() and np.isfinite(columns).all()):
        raise SimulationError("the models blow up behind such a leader")
    unexplained = residual - columns @ np.linalg.lstsq(columns, residual, rcond=None)[0]
    return float(unexplained @ unexplained)


def _driven(system: System, platoon: Sequence) -> np.ndarray:
    """``(K, N)`` paths behind the leader of a platoon, from its starts, m."""
    x = platoon.x[..., 0]
    engine = TrafficEngine([platoon], np.inf, None, np.inf)
    with torch.no_grad():
        states = engine.simulate(system, ParameterVector(system).row[None])[0]
    leader = np.arange(x.shape[1]) == x.shape[1] - 1
    return np.where(leader, x, states[:, 0, : x.shape[1], 0].numpy())


def _platoon(template: Sequence, time: np.ndarray, x: np.ndarray) -> Sequence:
    """The template's vehicles on other paths ``(K, N)``."""
    v = velocity(x[..., None], float(time[1] - time[0]))
    return replace(template, name="advised", time=time, x=x[..., None], v=v, agents=())


def _leaders(engine: TrafficEngine) -> np.ndarray:
    """Measured leaders' speeds, m/s."""
    return np.concatenate([s.velocity()[:, -1, 0] for s in engine.sequences])


def _excess(engine: TrafficEngine, first: System, second: System) -> float:
    """The overdispersion of the clusters' scores, relative to independent residuals."""
    rows = {s: ParameterVector(s).row[None] for s in (first, second)}
    r_first, r_second = (engine.residuals(s, row)[0].numpy() for s, row in rows.items())
    scores = group_sums(r_first * (r_first - r_second), engine.cluster)
    expected = float(((r_first - r_second) ** 2).sum())
    if len(scores) < 2 or not expected > 0:
        return 1.0
    return max(1.0, len(scores) * float(scores.var(ddof=1)) / expected)
