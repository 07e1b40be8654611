"""Equilibria of fitted laws, and whether disturbances grow from vehicle to vehicle.

With dv = v - v_l, the speed minus the leader's, and slopes of f(s, v, dv) at an equilibrium, a
small disturbance of frequency w passes from a leader's speed to its follower's by

    G(iw) = H (f_s - f_dv iw) / (-w² - H (f_v + f_dv) iw + H f_s),

H = 1 without an actuator lag (1/(1 + iw tau)) or a delay. For H = 1, |G|² <= 1 at all w asks for
w² + f_v² + 2 f_v f_dv - 2 f_s >= 0: the platoon is string stable if f_v²/2 + f_v f_dv - f_s >= 0.

Source: Treiber & Kesting 2013, Traffic Flow Dynamics, chapter 15; Wilson & Ward 2011, with the
slope by the gap's rate in place of -f_dv.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike

from nnode.data.sequence import Sequence, collate
from nnode.model.laws import Law
from nnode.model.system import System
from nnode.simulation.fused import FusedSolver

#: Gaps (m) among which equilibria are looked for.
GAPS = np.linspace(0.2, 250.0, 5000)
#: Step of numerical slopes: m, m/s.
STEP = 1e-4
#: Frequencies of disturbances, 1/s.
FREQUENCIES = np.geomspace(1e-3, 5.0, 1500)
#: Laws that say where a vehicle is a step later have no slopes in that sense.
MAPS = ("krauss", "newell")


def acceleration(
    system: System, gap: ArrayLike, v: ArrayLike, dv: ArrayLike, length: float
) -> np.ndarray:
    """m/s² of a law without its effects, elementwise.

    Args:
        gap: m, bumper to bumper.
        dv: own speed minus the leader's, m/s.
        length: of the leader, m.
    """
    law = system.find(Law)
    assert law is not None
    gap, v, dv = (torch.tensor(each) for each in np.broadcast_arrays(gap, v, dv))
    values = {
        "gap": gap + length,
        "v": v,
        "dv": dv,
        "v_1": v - dv,
        "dx_1": v - dv,
        "length_1": torch.full_like(gap, length),
        "dt": torch.full_like(gap, 0.1),
    }
    # a remembered time gap has faded to the common one where driving is even
    for state in law.dynamics().starts:
        values[state] = law.get_parameter("T").detach().expand(gap.shape)
    with torch.no_grad():
        return np.asarray(law.evaluated(values).expand(gap.shape).numpy())


def equilibrium(system: System, speeds: np.ndarray, length: float) -> np.ndarray:
    """Gap (m) at which a follower keeps each speed (m/s); NaN where there is none up to 250 m.

    Where there are several it is the least at which the acceleration rises through 0.
    """
    gaps = np.full(len(speeds), math.nan)
    for k, v in enumerate(speeds):
        rate = acceleration(system, GAPS, v, 0.0, length)
        up = np.flatnonzero((rate[:-1] < 0) & (rate[1:] >= 0))
        if up.size:
            i = int(up[0])
            gaps[k] = np.interp(0.0, rate[i : i + 2], GAPS[i : i + 2])
    return gaps


@dataclass(frozen=True)
class Slopes:
    """Of the acceleration at an equilibrium: by gap (1/s²), speed and approach (1/s)."""

    s: float
    v: float
    dv: float

    @property
    def margin(self) -> float:
        """f_v²/2 + f_v f_dv - f_s, 1/s²; at least 0 where a platoon is string stable."""
        return self.v**2 / 2 + self.v * self.dv - self.s


def slopes(system: System, gap: float, v: float, length: float) -> Slopes:
    """By central differences."""
    at = np.array([gap, v, 0.0]) + STEP * np.concatenate([np.eye(3), -np.eye(3)])
    rate = acceleration(system, at[:, 0], at[:, 1], at[:, 2], length)
    slope = (rate[:3] - rate[3:]) / (2 * STEP)
    return Slopes(*map(float, slope))


def passed(
    slope: Slopes, frequency: np.ndarray, lag: float = 0.0, delay: float = 0.0
) -> np.ndarray:
    """|G(iw)| of one follower at frequencies w, 1/s.

    Args:
        lag: time constant of the actuator, s.
        delay: s, by Padé's approximation of second order, as the effect has it.
    """
    z = 1j * np.asarray(frequency)
    late = (1 - z * delay / 2 + (z * delay) ** 2 / 12) / (1 + z * delay / 2 + (z * delay) ** 2 / 12)
    h = late / (1 + lag * z)
    gain = h * (slope.s - slope.dv * z) / (z**2 - h * (slope.v + slope.dv) * z + h * slope.s)
    return np.asarray(np.abs(gain))


def lateness(system: System) -> dict[str, float]:
    """``lag`` and ``delay`` of a model's effects, s."""
    late = {"lag": 0.0, "delay": 0.0}
    for term in system.terms:
        if term.name == "inertia":
            late["lag"] = float(term.get_parameter("tau_v").detach())
        elif term.name == "reaction_delay":
            late["delay"] = float(term.get_parameter("T").detach())
    return late


def platoon(
    system: System,
    v: float,
    gap: float,
    length: float,
    frequency: float,
    *,
    followers: int = 10,
    amplitude: float = 0.05,
    periods: int = 40,
) -> np.ndarray:
    """``(followers + 1,)`` amplitudes of speed, m/s, leader first, behind a leader whose speed
    swings around v: the last quarter of a simulation, when all swing evenly.

    Args:
        frequency: 1/s (2 pi over the period).
    """
    dt = 0.1
    time = dt * np.arange(math.ceil(periods * 2 * math.pi / frequency / dt))
    lead = v * time + amplitude / frequency * (1 - np.cos(frequency * time))
    behind = (gap + length) * np.arange(followers, -1, -1)
    x = np.stack([v * time - away for away in behind[:-1]] + [lead], -1)
    speed = np.full_like(x, v)
    speed[:, -1] += amplitude * np.sin(frequency * time)
    sequence = Sequence(
        name="platoon",
        recording="platoon",
        time=time,
        x=x[..., None],
        v=speed[..., None],
        length=np.full(followers + 1, length),
    )
    simulated = FusedSolver()(system, collate([sequence]))
    assert simulated.v is not None
    last = slice(3 * len(time) // 4, None)
    swing = simulated.v[last, 0, :, 0].detach().numpy()[:, ::-1]
    wave = np.exp(-1j * frequency * time[last])
    # the part at the leader's frequency, by least squares on sine and cosine
    basis = np.stack([wave.real, wave.imag, np.ones(len(wave))], -1)
    return np.hypot(*np.linalg.lstsq(basis, swing, rcond=None)[0][:2])
