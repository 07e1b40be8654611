"""How people walk, whatever the law: their sway as they step, and how much they accelerate.

Source: Hoogendoorn & Daamen 2005; Liu, Song & Zhang 2009 (lateral sway); the statistical model is
that of :class:`~nnode.population.likelihood.RestartNoise`.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from nnode.calibrate.intervals import at_bounds
from nnode.diagnosis.crowds.people import OUTLYING, Gait, People, lost, outlying_weights
from nnode.population.drivers import TOLERANCE
from nnode.population.estimate import Variances, fit_variances
from nnode.population.likelihood import Linearised

#: s; sampled more coarsely, sway is not resolved: people make two steps per second.
RESOLVED = 0.15
#: Bounds of searches, and in their middle where they start: of the standard deviations across and
#: along the direction of walking, m, the frequency, Hz, and the time for which sway lasts, s. Slow
#: turns of the path, such as evasions, have lower frequencies.
SWAY = ((1e-4, 0.02, 0.2), (1e-4, 0.005, 0.1), (0.65, 0.95, 1.3), (0.5, 3.0, 30.0))
#: Place of the frequency.
FREQUENCY = 2


def estimated_gait(people: People) -> Gait:
    """The gait without a law, so that all laws are compared with the same: everybody walks on with
    the smoothed velocity at the start of the record, and is pushed.

    Sway is found if it raises the likelihood by more than its parameters need (Schwarz 1978), and
    if its frequency is within its bounds.

    Args:
        people: their gait is not used.
    """
    windows, plain = walking_straight(people), people.initial_variances([])
    data = _records(people)
    plain = fit_variances(data, people.noise, plain, tolerance=TOLERANCE)
    low, start, high = np.array(SWAY).T

    def gait(variances: Variances) -> Gait:
        weight, terms = window_log_likelihoods(people, windows, variances.noise)
        records = replace(data, weight=people.at_samples(weight))
        return Gait(
            sway=variances.noise[len(plain.noise) :],
            acceleration=float(variances.noise[0]),
            window_loglik=terms,
            loglik=people.posterior(records, [], variances).loglik - float(lost(records).sum()),
        )

    if data.dt > RESOLVED:
        return gait(plain)
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
    at_bound = at_bounds(np.log(sway), np.log(low), np.log(high), TOLERANCE)[FREQUENCY]
    found = after > before + price and not at_bound
    return gait(swaying if found else plain)


def walking_straight(people: People) -> Linearised:
    """The windows of people who walk on with the velocity at the start of a window; each is a
    segment."""
    x, v, measured = _walks(people)
    heading = people.parted(people.heading.reshape(len(people.pairs), -1))
    return _straight(
        people.windows.interval,
        x,
        v,
        measured,
        observed=np.ones((len(x), 2 * people.windows.length), dtype=bool),
        heading=heading.reshape(measured.shape),
    )


def _records(people: People) -> Linearised:
    """The records of people who walk on with the velocity at their start."""
    x, v, measured = _walks(people)
    return _straight(
        people.windows.interval,
        people.by_number(x)[:, 0],
        people.by_number(v)[:, 0],
        people.joined(measured),
        observed=people.at_samples(np.ones(len(x), dtype=bool)),
        heading=people.heading,
    )


def _walks(people: People) -> tuple[np.ndarray, ...]:
    """Smoothed positions (m) and velocities (m/s) at the starts of windows, ``(P, 2)``, and
    measured positions ``(P, L, 2)``, m."""
    windows, (window, place) = people.windows, people.windows.person.T
    x, v = (array[0, window, place].numpy() for array in (windows.batch.x, windows.batch.v))
    return x, v, windows.measured[:, window, place].swapaxes(0, 1)


def _straight(
    dt: float,
    x: np.ndarray,
    v: np.ndarray,
    measured: np.ndarray,
    *,
    observed: np.ndarray,
    heading: np.ndarray,
) -> Linearised:
    """S segments ``(S, T, 2)`` of people without a law, who start at ``x`` with ``v``."""
    number, times = measured.shape[:2]
    straight = x[:, None] + dt * np.arange(times)[:, None] * v[:, None]
    restart = np.zeros((number, times), dtype=bool)
    restart[:, 0] = True
    one, zero = np.eye(2), np.zeros((2, 2))
    free = np.block([[one, dt * one], [zero, one]])
    pushed = np.concatenate([dt**2 / 4 * one, dt / 2 * one])
    none = np.zeros((number, 2 * times, 0))
    return Linearised(
        residual=(measured - straight).reshape(number, -1),
        fixed=none,
        random=np.zeros(0, dtype=int),
        start=none,
        observed=observed,
        agent=np.arange(number),
        step=np.broadcast_to(free, (number, times - 1, 4, 4)),
        forced=np.broadcast_to(pushed, (number, times - 1, 4, 2)),
        restart=restart,
        heading=heading,
        dt=dt,
    )


def window_log_likelihoods(
    people: People, windows: Linearised, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """``(P,)`` weights and log likelihoods of the windows by themselves, with the loss of outlying
    ones."""
    products = people.noise.products(windows, noise)
    square, samples = products.gram[:, 0, 0], windows.residual.shape[1]
    weight = outlying_weights(square)
    robust = weight * square - OUTLYING * samples * np.log(weight)
    terms: np.ndarray = -(robust + products.logdet + samples * math.log(2 * math.pi)) / 2
    return weight, terms
