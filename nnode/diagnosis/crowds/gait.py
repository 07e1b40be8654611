"""How people walk, whatever the law: their sway as they step, and how much they accelerate.

Source: Hoogendoorn & Daamen 2005; Liu, Song & Zhang 2009 (lateral sway); the statistical model is
that of :class:`~nnode.population.likelihood.RestartNoise`.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from nnode.calibrate.intervals import at_bounds
from nnode.diagnosis.crowds.people import Gait, People
from nnode.population.drivers import TOLERANCE
from nnode.population.estimate import fit_variances
from nnode.population.likelihood import Linearised

#: s; sampled more coarsely, sway is not resolved: people make two steps per second.
RESOLVED = 0.15
#: Bounds of searches, and in their middle where they start: of the standard deviations across and
#: along the direction of walking, m, the frequency, Hz, and the time for which sway lasts, s. Slow
#: turns of the path, such as evasions, have lower frequencies.
SWAY = ((1e-4, 0.02, 0.2), (1e-4, 0.005, 0.1), (0.65, 0.95, 1.3), (0.5, 3.0, 30.0))
#: Place of the frequency, and how close its logarithm is to a bound if it is at the bound.
FREQUENCY, NEAR = 2, 1e-3


def estimated_gait(people: People) -> Gait:
    """The gait without a law, so that all laws are compared with the same: in each window everybody
    walks on with the smoothed velocity at its start, and is pushed.

    Sway is found if it raises the likelihood by more than its parameters need (Schwarz 1978), and
    if its frequency is within its bounds.

    Args:
        people: their gait is not used.
    """
    data, plain = _walking_straight(people), people.initial_variances([])
    plain = fit_variances(data, people.noise, plain, tolerance=TOLERANCE)
    low, start, high = np.array(SWAY).T
    without = Gait(np.zeros(0), float(plain.noise[0]))
    if data.dt > RESOLVED:
        return without
    swaying = replace(
        plain,
        noise=np.concatenate([plain.noise, start]),
        low=np.concatenate([plain.low, low]),
        high=np.concatenate([plain.high, high]),
    )
    swaying = fit_variances(data, people.noise, swaying, tolerance=TOLERANCE)
    before, after = (people.posterior(data, [], each).loglik for each in (plain, swaying))
    sway = swaying.noise[len(plain.noise) :]
    price = len(sway) * math.log(max(len(people.pairs), 2)) / 2
    at_bound = at_bounds(np.log(sway), np.log(low), np.log(high), NEAR)[FREQUENCY]
    found = after > before + price and not at_bound
    return Gait(sway, float(swaying.noise[0])) if found else without


def _walking_straight(people: People) -> Linearised:
    """The paths of people who walk on with the velocity at the start of a window."""
    windows, dt = people.windows, people.windows.interval
    number, times = len(people.unit), windows.length
    window, place = windows.person.T
    x, v = (array[0, window, place].numpy() for array in (windows.batch.x, windows.batch.v))
    straight = x[:, None] + dt * np.arange(times)[:, None] * v[:, None]
    measured = windows.measured[:, window, place].swapaxes(0, 1)
    one, zero = np.eye(2), np.zeros((2, 2))
    free = np.block([[one, dt * one], [zero, one]])
    pushed = np.concatenate([dt**2 / 4 * one, dt / 2 * one])
    observed = people.joined(np.ones((number, 2 * times), dtype=bool))
    none = np.zeros((*observed.shape, 0))
    intervals = len(observed), observed.shape[1] // 2 - 1
    return Linearised(
        residual=people.joined(measured - straight),
        fixed=none,
        random=np.zeros(0, dtype=int),
        start=none,
        observed=observed,
        agent=np.arange(len(observed)),
        step=np.broadcast_to(free, (*intervals, 4, 4)),
        forced=np.broadcast_to(pushed, (*intervals, 4, 2)),
        restart=people.restarts(),
        heading=people.heading,
        dt=dt,
    )
