"""Small platoons with known effects, by Runge and Kutta's method at a fifth of the sampling
interval, written without the package's models."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from nnode.data.sequence import Sequence

V0, LENGTH, DT, SUBSTEPS = 28.0, 6.0, 0.2, 5

#: Of positions with the leader's, the law's speeds and the leader's speed: m/s of the followers.
Effect = Callable[[np.ndarray, np.ndarray, float], np.ndarray]


def _leader(
    rng: np.random.Generator, time: np.ndarray, calm: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    waves = [
        (calm * rng.uniform(0.8, 2.0), rng.uniform(8, 30), rng.uniform(0, 6)) for _ in range(4)
    ]
    speed = 17 + sum(a * np.sin(2 * np.pi * time / p + q) for a, p, q in waves)
    step = time[1] - time[0]
    place = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2) * step])
    return place, speed


def platoons(
    effect: Effect | None = None,
    *,
    number: int = 10,
    vehicles: int = 5,
    seconds: float = 20.0,
    noise: float = 0.02,
    driver: float = 0.0,
    calm: float = 1.0,
    seed: int = 0,
) -> list[Sequence]:
    """Platoons behind a leader whose speed varies, ``calm`` times as much; ``driver`` is the
    standard deviation (m/s) of an Ornstein-Uhlenbeck disturbance of every follower's speed with
    3 s correlation."""
    rng = np.random.default_rng(seed)
    half = DT / SUBSTEPS / 2  # the leader is known at half steps
    samples, warm = round(seconds / DT) + 1, round(15 / DT)
    found = []
    for s in range(number):
        time = half * np.arange(2 * SUBSTEPS * (samples + warm) + 2)
        lead, speed = _leader(rng, time, calm)
        gap = LENGTH * V0 / (V0 - speed[0])
        x = lead[0] - gap * np.arange(vehicles - 1, 0, -1.0)
        push = driver * rng.normal(size=vehicles - 1)
        rows = []

        def rate(
            x: np.ndarray,
            i: int,
            push: np.ndarray,
            lead: np.ndarray = lead,
            speed: np.ndarray = speed,
        ) -> np.ndarray:
            every = np.append(x, lead[i])
            law = V0 * (1 - LENGTH / np.diff(every))
            return push + (law if effect is None else effect(every, law, speed[i]))

        for k in range(samples + warm):
            if k >= warm:
                rows.append(np.append(x, lead[2 * SUBSTEPS * k]))
            for sub in range(SUBSTEPS):
                i = 2 * (SUBSTEPS * k + sub)
                k1 = rate(x, i, push)
                k2 = rate(x + half * k1, i + 1, push)
                k3 = rate(x + half * k2, i + 1, push)
                k4 = rate(x + 2 * half * k3, i + 2, push)
                x = x + 2 * half / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
                keep = np.exp(-2 * half / 3)
                push = keep * push + driver * np.sqrt(1 - keep**2) * rng.normal(size=len(push))
        place = np.array(rows)
        place += noise * rng.normal(size=place.shape)
        clock = 100.0 * s + DT * np.arange(samples)
        found.append(Sequence(name=f"r/{s}", recording="r", time=clock, x=place[..., None]))
    return found


def streams(
    *,
    number: int = 8,
    vehicles: int = 5,
    seconds: float = 40.0,
    window: float = 10.0,
    noise: float = 0.02,
    mood: float = 0.0,
    lasts: float = 6.0,
    pace: float = 0.0,
    seed: int = 0,
) -> list[Sequence]:
    """Platoons that drive for long, cut into windows that keep names and clock.

    Args:
        mood: standard deviation, m/s, of an Ornstein-Uhlenbeck disturbance of every follower's
            speed, of ``lasts`` s correlation.
        pace: of the drivers' own paces, relative to the law.
    """
    rng = np.random.default_rng(seed)
    half = DT / SUBSTEPS / 2
    samples, warm = round(seconds / DT) + 1, round(15 / DT)
    time = half * np.arange(2 * SUBSTEPS * (samples + warm) + 2)
    each = [_leader(rng, time) for _ in range(number)]
    lead, speed = (np.stack(parts) for parts in zip(*each, strict=True))
    gap = LENGTH * V0 / (V0 - speed[:, :1])
    x = lead[:, :1] - gap * np.arange(vehicles - 1, 0, -1.0)
    push, own = mood * rng.normal(size=x.shape), 1 + pace * rng.normal(size=x.shape)
    keep = np.exp(-2 * half / lasts)
    rows = []

    def rate(x: np.ndarray, i: int) -> np.ndarray:
        return push + own * V0 * (1 - LENGTH / np.diff(np.append(x, lead[:, [i]], 1), axis=1))

    for k in range(samples + warm):
        if k >= warm:
            rows.append(np.append(x, lead[:, [2 * SUBSTEPS * k]], 1))
        for sub in range(SUBSTEPS):
            i = 2 * (SUBSTEPS * k + sub)
            k1 = rate(x, i)
            k2 = rate(x + half * k1, i + 1)
            k3 = rate(x + half * k2, i + 1)
            k4 = rate(x + 2 * half * k3, i + 2)
            x = x + 2 * half / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            push = keep * push + mood * np.sqrt(1 - keep**2) * rng.normal(size=x.shape)
    place = np.array(rows) + noise * rng.normal(size=(samples, number, vehicles))
    size = round(window / DT)
    return [
        Sequence(
            name=f"r/{s}-{first // size}",
            recording="r",
            time=(seconds + 50) * s + DT * np.arange(first, first + size + 1),
            x=place[first : first + size + 1, s, :, None],
            agents=tuple(f"{s}-{n}" for n in range(vehicles)),
            kind=("car", "truck", *["car"] * (vehicles - 2)),
        )
        for s in range(number)
        for first in range(0, samples - size, size)
    ]


def relative_speed(kappa: float) -> Effect:
    """W + kappa (speed ahead - W), from the leader backwards."""

    def effect(x: np.ndarray, law: np.ndarray, lead: float) -> np.ndarray:
        speed, found = lead, np.empty_like(law)
        for i in range(len(law) - 1, -1, -1):
            speed = found[i] = law[i] + kappa * (speed - law[i])
        return found

    return effect


def delayed(delay: float, number: int = 4, seconds: float = 20.0) -> list[Sequence]:
    """Platoons of three that see their gap as it was ``delay`` s ago; small Euler steps."""
    rng = np.random.default_rng(3)
    step = DT / 200
    late, every = round(delay / step), 200
    samples, warm = round(seconds / DT) + 1, round(20 / DT)
    found = []
    for s in range(number):
        lead, speed = _leader(rng, step * np.arange((samples + warm) * every))
        gap = LENGTH * V0 / (V0 - speed[0])
        x = np.empty((len(lead), 3))
        x[:, 2] = lead
        x[: late + 1] = lead[: late + 1, None] - gap * np.array([2.0, 1.0, 0.0])
        for k in range(late, len(lead) - 1):
            seen = np.diff(x[k - late])
            x[k + 1, :2] = x[k, :2] + step * V0 * (1 - LENGTH / seen)
        place = x[warm * every :: every]
        clock = 100.0 * s + DT * np.arange(len(place))
        found.append(Sequence(name=f"r/{s}", recording="r", time=clock, x=place[..., None]))
    return found
