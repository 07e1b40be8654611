"""The linear response of people in contact, against finite differences of SciPy's solutions.

The derivative of the social force jumps at a contact.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from nnode.data.sequence import Sequence, collate
from nnode.model import Crowd, make_law
from nnode.simulation.alone import PersonAlone, RunAlone, Surroundings

#: A, k, kappa.
STRENGTHS = np.array([2.0, 30.0, 20.0])
B, R, TAU = 0.1, 0.25, 0.5
GOAL = np.array([20.0, 0.0])
#: State of a person, and positions of two others, of whom the first comes into contact: m, m/s.
START, OTHERS = np.array([0.0, 0.0, 1.3, 0.0]), np.array([[2.6, 0.32], [4.0, -0.6]])
PACE, SECONDS = np.array([-1.2, 0.0]), 2.0


def acceleration(t: float, y: np.ndarray, strengths: np.ndarray) -> np.ndarray:
    """Acceleration of the person, m/s²: relaxation and the social force of N = 3 people."""
    big, k, kappa = strengths
    x, v = y[:2], y[2:]
    ahead = (GOAL - x) / np.linalg.norm(GOAL - x)
    total = (np.linalg.norm(v) * ahead - v) / TAU
    for place in OTHERS + PACE * t:
        d = float(np.linalg.norm(x - place))
        n, touch = (x - place) / d, max(2 * R - d, 0.0)
        along = np.array([-n[1], n[0]])
        push = (big * np.exp((2 * R - d) / B) + k * touch) * n
        total += (push + kappa * touch * ((PACE - v) @ along) * along) / 3
    return total


def integrated(change: np.ndarray, steps: int, contact: float) -> np.ndarray:
    """``(steps + 1, 2)`` positions.

    Args:
        change: of x, y, vx and vy at the start, of A, k and kappa, and size of a push.
        contact: factor of k and kappa.
    """
    strengths = STRENGTHS * [1.0, contact, contact] + change[4:7]

    def rate(t: float, y: np.ndarray) -> np.ndarray:
        return np.append(y[2:], acceleration(t, y, strengths) + change[7] * pushed(t))

    time = np.linspace(0.0, SECONDS, steps + 1)
    tight = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-11, "max_step": 0.01}
    return solve_ivp(rate, (0.0, SECONDS), START + change[:4], t_eval=time, **tight).y[:2].T


def pushed(t: Any) -> np.ndarray:
    return np.stack([np.cos(3 * t), np.sin(5 * t)], -1)


def run(steps: int, contact: float) -> RunAlone:
    """The package's simulation of the person among the paths of the others."""
    time = np.linspace(0.0, SECONDS, 2 * steps + 1)
    place = OTHERS + PACE * time[:, None, None]
    straight = START[:2] + START[2:] * time[:, None]
    x = np.concatenate([straight[:, None], place], 1)
    v = np.broadcast_to(np.stack([START[2:], PACE, PACE]), x.shape)
    goals = np.stack([GOAL, -GOAL, -GOAL])
    batch = collate([Sequence(name="s", recording="r", time=time, x=x, v=v, destination=goals)])
    big, k, kappa = STRENGTHS * [1.0, contact, contact]
    force = make_law("social_force", A=big, k=k, kappa=kappa, B=B, r=R, walls=False)
    system = Crowd([make_law("relaxation", tau=TAU), force]).double()
    window = torch.zeros(1, dtype=torch.long)
    around = Surroundings(system.scene(batch), batch.x, batch.v, window, window, SECONDS / steps)
    values = {name: p.detach()[None] for name, p in system.named_parameters()}
    start = torch.cat([batch.x[0], batch.v[0]], -1)
    states = PersonAlone(around, system, values).simulated(start, steps)[:, 0]
    return RunAlone(around, system, states)


def errors(steps: int, contact: float) -> np.ndarray:
    """The largest relative error of the response to each change."""
    linear = run(steps, contact)
    push = torch.zeros(steps + 1, 1, 3, 2, dtype=torch.float64)
    push[:, 0, 0] = torch.from_numpy(pushed(np.linspace(0.0, SECONDS, steps + 1)))
    by_rates = linear.displacements([*linear.parameters([1e-4] * 3), push])
    responses = np.concatenate([linear.by_start()[0], by_rates[0]], -1)[:, :2].transpose(2, 0, 1)
    h, relative = 1e-5, []
    for unit, response in zip(np.eye(8), responses, strict=True):
        upper, lower = (integrated(sign * h * unit, steps, contact) for sign in (1, -1))
        expected = (upper - lower) / (2 * h)
        relative.append(np.abs(response - expected).max() / np.abs(expected).max())
    return np.array(relative)


@pytest.mark.thorough
@pytest.mark.parametrize(("contact", "order", "most"), [(0.0, 2, 0.01), (1.0, 1, 0.1)])
def test_responses(contact: float, order: int, most: float) -> None:
    """The order is that of the interpolation of the force's derivative between the steps. At a
    contact the derivative jumps within a step."""
    coarse, fine = errors(25, contact), errors(100, contact)
    assert fine.max() < most
    assert fine.max() < 2 * coarse.max() / 4**order
