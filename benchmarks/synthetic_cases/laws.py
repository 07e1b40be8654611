"""Measured platoons of laws of the literature, integrated step by step as their sources say.

Laws of accelerations are stepped by :data:`STEP` s, and positions with the mean of the old and the
new speed (Treiber & Kanagaraj 2015). Krauss' law is the map that SUMO steps, Gipps' the map of his
paper, whose step is the reaction time; both are linear in between. Accelerations of drivers, or
speeds of laws of first order, are disturbed for some seconds at a time.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import numpy as np
import pandas as pd

from nnode.errors import ConfigError

#: s, of the simulations.
STEP = 0.05
#: m/s, below which disturbances of laws of first order fade.
SLOW = 5.0
#: s: simulated before the recording.
WARM = 20.0
#: Standard deviation of drivers' disturbances, m/s² and m/s, and their correlation time, s.
PUSH, FIRST_PUSH, LASTS = (0.05, 0.3), (0.1, 0.4), (1.0, 5.0)
#: Errors of measured positions, m; in half of the cases they have this correlation time, s.
ERROR, ERROR_LASTS = (0.02, 0.3), 1.0
Parameters = dict[str, float]

#: Law to the ranges that its parameters are drawn from: m, s, and what is made of them.
RANGES: dict[str, dict[str, tuple[float, float]]] = {
    "lin": {"v0": (20, 35), "L": (5, 9)},
    "log": {"v0": (8, 18), "L": (5, 9)},
    "idm": {"v0": (20, 35), "T": (0.8, 1.8), "s0": (1.5, 3), "a": (0.6, 2), "b": (1, 2.5)},
    "ovm": {"kappa": (1.0, 2.5), "v0": (20, 35), "s_c": (12, 25), "w": (6, 15)},
    "fvdm": {"kappa": (0.2, 0.8), "lam": (0.2, 0.8), "v0": (20, 35), "s_c": (12, 25), "w": (6, 15)},
    "helly": {"c_s": (0.05, 0.2), "c_v": (0.3, 0.8), "T": (0.8, 1.8), "s0": (2, 5)},
    "krauss": {"v0": (20, 35), "T": (0.8, 1.5), "s0": (1, 2.5), "a": (0.8, 2.5), "b": (1.5, 4.5)},
    "gipps": {
        "v0": (20, 35),
        "T": (0.6, 1.2),
        "s0": (1.5, 3),
        "a": (0.8, 2),
        "b": (1.5, 3),
        "guess": (0.8, 1.2),
    },
}
#: Steps (s) of laws that are maps.
MAPS: dict[str, Callable[[Parameters], float]] = {
    "krauss": lambda p: 0.1,
    "gipps": lambda p: round(p["T"] / STEP) * STEP,
}
FIRST_ORDER = ("lin", "log")


def measured(
    law: str,
    seed: int,
    *,
    sequences: int = 40,
    vehicles: int = 5,
    seconds: float = 30.0,
    dt: float = 0.2,
) -> tuple[pd.DataFrame, Parameters]:
    """The table (sequence, time, agent, x, length) of a law and a seed, and the law's parameters.

    Args:
        law: a name of :data:`RANGES`.
        seed: of everything random; equal arguments give equal tables.
        vehicles: of a platoon, its leader included.
        seconds: duration of a sequence, s.
        dt: sampling interval, s.

    Raises:
        ConfigError: an unknown law.
    """
    if law not in RANGES:
        raise ConfigError(f"law={law} is unknown, expected one of {', '.join(RANGES)}")
    rng = np.random.default_rng(list(hashlib.sha256(f"{law} {seed}".encode()).digest()))
    p = {name: float(rng.uniform(*ends)) for name, ends in RANGES[law].items()}
    size = rng.uniform(*(FIRST_PUSH if law in FIRST_ORDER else PUSH))
    lasts, error = rng.uniform(*LASTS), rng.uniform(*ERROR)
    keep = np.exp(-dt / ERROR_LASTS) if rng.random() < 0.5 else 0.0
    fastest = 0.85 * p.get("v0", 30.0) * (1 if law != "log" else 1.5)
    every, steps = round(dt / STEP), round((WARM + seconds) / STEP) + 1
    tables = []
    for s in range(sequences):
        length = rng.uniform(4.0, 5.5, vehicles)
        lead = _leader(rng, steps, fastest)
        push = _fading(rng, (steps, vehicles - 1), np.exp(-STEP / lasts), size)
        x = followed(law, p, lead, length, push)[round(WARM / STEP) :: every]
        x = x - x[0, -1] + _fading(rng, x.shape, keep, error)
        k, n = (axis.ravel() for axis in np.indices(x.shape))
        tables.append(
            pd.DataFrame(
                {
                    "sequence": f"s{s:03d}",
                    "time": 1000.0 * s + dt * k,
                    "agent": [f"{s}-{i}" for i in n],
                    "x": x.ravel(),
                    "length": length[n],
                }
            )
        )
    return pd.concat(tables, ignore_index=True), p


def accelerations(rng: np.random.Generator, steps: int, step: float) -> list[float]:
    """At least ``steps`` accelerations of a leader, m/s²: for 2 to 7 s each it keeps its speed,
    accelerates or brakes."""
    found: list[float] = []
    while len(found) < steps:
        rate = rng.choice([0.0, rng.uniform(0.3, 1.2), -rng.uniform(0.3, 2.0)])
        found += [float(rate)] * round(rng.uniform(2, 7) / step)
    return found


def _leader(rng: np.random.Generator, steps: int, fastest: float) -> np.ndarray:
    """``(K,)`` positions, m."""
    rates = accelerations(rng, steps, STEP)
    speed = [float(rng.uniform(0.3, 0.9) * fastest)]
    for rate in rates[: steps - 1]:
        speed.append(min(max(speed[-1] + STEP * rate, 0.0), fastest))
    return np.concatenate([[0.0], np.cumsum(speed[:-1])]) * STEP


def _fading(
    rng: np.random.Generator, shape: tuple[int, ...], keep: float, size: float
) -> np.ndarray:
    """Noise of a standard deviation, of which a step keeps a share."""
    found = size * rng.normal(size=shape)
    for k in range(1, shape[0]):
        found[k] = keep * found[k - 1] + np.sqrt(1 - keep**2) * found[k]
    return found


def followed(
    law: str, p: Parameters, lead: np.ndarray, length: np.ndarray, push: np.ndarray
) -> np.ndarray:
    """``(K, N)`` places, m, of N vehicles at steps of :data:`STEP`, the last in front.

    Args:
        lead: ``(K,)`` place of the leader, m.
        length: ``(N,)`` of the vehicles, m. Gaps are net, but in lin and log.
        push: ``(K, N - 1)`` disturbances of the followers, m/s² or m/s.
    """
    number, speed = len(length), np.gradient(lead, STEP)
    x, v = np.empty((len(lead), number)), np.empty((len(lead), number))
    x[:, -1], v[:, -1] = lead, speed
    for i in range(number - 2, -1, -1):
        x[0, i] = x[0, i + 1] - length[i + 1] - still(law, p, speed[0], length[i + 1])
        _drive(law, p, x, v, i, length[i + 1], push[:, i])
    return x


def _drive(
    law: str, p: Parameters, x: np.ndarray, v: np.ndarray, i: int, ahead: float, push: np.ndarray
) -> None:
    """Fill the paths of vehicle ``i`` behind the next one."""
    wait = round(MAPS[law](p) / STEP) if law in MAPS else 1
    now, goal, begun = float(v[0, i + 1]), 0.0, 0.0
    for k in range(len(x)):
        v[k, i] = now
        if k + 1 == len(x):
            return
        gap, front = float(x[k, i + 1] - x[k, i] - ahead), float(v[k, i + 1])
        if law in FIRST_ORDER:
            wish = _speed(law, p, gap + ahead)
            now = wish + push[k] * min(max(wish, 0.0) / SLOW, 1.0)  # who stands is not pushed
            v[k, i] = now
            x[k + 1, i] = x[k, i] + STEP * now
            continue
        if law in MAPS:
            if k % wait == 0:
                begun = now
                goal = _mapped(law, p, gap, now, front) + wait * STEP * push[k]
            rate = (max(goal, 0.0) - begun) / (wait * STEP)
        else:
            rate = _acceleration(law, p, max(gap, 0.1), now, front) + push[k]
        later = max(now + STEP * rate, 0.0)
        x[k + 1, i] = x[k, i] + STEP * (now + later) / 2
        now = later


def _speed(law: str, p: Parameters, spacing: float) -> float:
    spacing = max(spacing, p["L"])
    found = p["v0"] * (1 - p["L"] / spacing if law == "lin" else np.log(spacing / p["L"]))
    return float(found)


def _acceleration(law: str, p: Parameters, gap: float, v: float, front: float) -> float:
    closing = v - front
    if law == "idm":
        wish = p["s0"] + max(v * p["T"] + v * closing / (2 * np.sqrt(p["a"] * p["b"])), 0.0)
        return float(p["a"] * (1 - (v / p["v0"]) ** 4 - (wish / gap) ** 2))
    if law == "helly":
        return p["c_s"] * (gap - p["s0"] - p["T"] * v) - p["c_v"] * closing
    offset = np.tanh(p["s_c"] / p["w"])
    wish = p["v0"] * (np.tanh((gap - p["s_c"]) / p["w"]) + offset) / (1 + offset)
    return float(p["kappa"] * (wish - v) - p.get("lam", 0.0) * closing)


def _mapped(law: str, p: Parameters, gap: float, v: float, front: float) -> float:
    """The speed one step of the map later, m/s."""
    if law == "krauss":
        room, brake = gap - p["s0"], p["b"] * p["T"]
        safe = -brake + np.sqrt(max(brake**2 + front**2 + 2 * p["b"] * room, 0.0))
        return float(min(v + p["a"] * MAPS[law](p), p["v0"], safe if room > 0 else 0.0))
    tau, b, guess = p["T"], p["b"], p["b"] * p["guess"]
    freely = v + 2.5 * p["a"] * tau * (1 - v / p["v0"]) * np.sqrt(0.025 + v / p["v0"])
    room = b * (2 * (gap - p["s0"]) - v * tau + front**2 / guess)
    safe = -b * tau + np.sqrt(max((b * tau) ** 2 + room, 0.0))
    return float(min(freely, safe))


def still(law: str, p: Parameters, speed: float, ahead: float) -> float:
    """Net gap in which a vehicle keeps a speed behind another one, m; by bisection."""
    low, high = 0.1, 300.0
    for _ in range(60):
        gap = (low + high) / 2
        if law in FIRST_ORDER:
            more = _speed(law, p, gap + ahead) < speed
        elif law in MAPS:
            more = _mapped(law, p, gap, speed, speed) < speed
        else:
            more = _acceleration(law, p, gap, speed, speed) < 0
        low, high = (gap, high) if more else (low, gap)
    return high
