"""The motion of people against closed forms, symmetry and another integrator.

Places, velocities and forces are complex numbers.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from benchmarks.synthetic_cases.crowd import motion
from benchmarks.synthetic_cases.crowd.motion import Base, Hidden, People, accelerations, simulate

BASE = Base(A=16.0, k=400.0, kappa=20.0)
FREE = Base(A=0.0, k=0.0, kappa=0.0)
# without contacts, whose kink lowers the order of every method
SMOOTH = Base(A=16.0, k=0.0, kappa=0.0)
NOTHING = Hidden()
WALL = np.array([[-5, 5]], complex)


def acceleration(
    x,
    v,
    base=BASE,
    hidden=NOTHING,
    goal=None,
    group=None,
    points=(),
    walls=WALL[:0],
    clock=0.0,
    eta=0.0,
    since=0.0,
):
    """``(N,)`` accelerations (m/s²); without ``goal`` people steer straight ahead."""
    x, v = np.array(x, complex), np.array(v, complex)
    group = np.full(len(x), -1) if group is None else np.array(group)
    goal = x + 1e6 * v if goal is None else np.array(goal, complex)
    people = People(x, v, goal, group, np.full(len(x), eta))
    return accelerations(base, hidden, people, np.array(points, complex), walls, clock, since)


def decay(distance: float, size: float = 16.0, reach: float = 0.3) -> float:
    return size * float(np.exp(-distance / reach))


#: Velocities of a pair that approaches head-on, and of a pair that walks in the same direction.
X, V, AFTER = [0, 1.2], [1, -1], [1, 0.5]
PAIR = decay(1.2 - 0.5) / 2
TURN = np.exp(0.5j)


@pytest.mark.parametrize(
    ("x", "v", "scene", "expected"),
    [
        # relaxation to the direction of the destination at the current speed
        ([0], [1.5], {"goal": [100j], "base": FREE}, [-3 + 3j]),
        ([0], [1.5], {"goal": [100j], "base": FREE, "eta": 0.5}, [-4.5 + 4.5j]),
        # the social force without and with contact and sliding
        ([0, 1], [1, 1], {}, [-decay(0.5) / 2, decay(0.5) / 2]),
        (
            [0, 0.4],
            [1j, -1j],
            {},
            [-(decay(-0.1) + 40) / 2 - 2j, (decay(-0.1) + 40) / 2 + 2j],
        ),
        # the mean over points of walls
        ([0.5j], [1], {"points": [0, 100, 200, 300]}, [decay(0.25) * 1j / 4]),
        # effects on the pair force
        (X, AFTER, {"hidden": Hidden(lambda_=0.2)}, [-PAIR, 0.2 * PAIR]),
        (X, V, {"hidden": Hidden(T_a=0.2)}, [-decay(0.3) / 2, decay(0.3) / 2]),
        (X, V, {"hidden": Hidden(theta=0.5)}, [-PAIR * TURN, PAIR * TURN]),
        (X, AFTER, {"hidden": Hidden(theta=0.5)}, [-PAIR, PAIR]),
        # friction acts along the tangent
        (
            [0, 1j],
            [1, -1],
            {"base": FREE, "hidden": Hidden(friction=0.6)},
            [-1.2 * np.exp(-1), 1.2 * np.exp(-1)],
        ),
        # group cohesion
        (
            [0, 1j, 2, 3 + 3j],
            [1] * 4,
            {"base": FREE, "hidden": Hidden(cohesion=0.5), "group": [0, 0, 0, -1]},
            [0.5 + 0.25j, 0.5 - 0.5j, -1 + 0.25j, 0],
        ),
        # walls repel from their nearest point
        *(
            ([x], [1], {"base": FREE, "hidden": Hidden(A_w=0.5, B_w=0.4), "walls": WALL}, [a])
            for x, a in (
                (1 + 0.65j, decay(0.4, 0.5, 0.4) * 1j),
                (8 + 4j, decay(4.75, 0.5, 0.4) * (0.6 + 0.8j)),
            )
        ),
    ],
)
def test_accelerations_by_hand(x, v, scene, expected):
    np.testing.assert_allclose(acceleration(x, v, **scene), expected, atol=1e-9)


@pytest.mark.parametrize(
    ("hidden", "expected"),
    [
        (Hidden(A_2=0.5, B_2=0.8), -decay(0.7, 0.5, 0.8)),
        (Hidden(side=0.4), -0.4j * (1 - np.exp(-1 / (1 + np.exp(-6.0))))),
        (Hidden(align=0.3), -0.6),
        (Hidden(a_x=0.2, a_y=-0.1), 0.2 - 0.1j),
        (Hidden(pull=0.5, v_pref=1.4), 0.2),
        (Hidden(dense=0.5), -0.5 * np.exp(-0.72) / (2 * np.pi)),
        (Hidden(A_o=2.0, B_o=0.5, x_o=0.0, y_o=-1.0), 2j * np.exp(-2.0)),
        (Hidden(A_o=2.0, B_o=0.5, x_o=0.0, y_o=-1.0, bell=1.0), 2j * np.exp(-2.0)),
        (Hidden(tiring=0.1), -0.2),
        (Hidden(push=0.3, push_T=1.0), 0.3j),
    ],
)
def test_effects_without_base_force_by_hand(hidden, expected):
    result = acceleration(X, V, FREE, hidden, clock=0.25, since=2.0)
    np.testing.assert_allclose(result[0], expected, atol=1e-9)


def test_accelerations_rotate_with_the_scene():
    rng, turn = np.random.default_rng(4), np.exp(0.7j)
    x, v = (rng.uniform(0, 4, (6, 2)) @ [1, 1j], rng.normal(0, 1, (6, 2)) @ [1, 1j])
    strengths = {"A_2": 0.3, "lambda_": 0.3, "T_a": 0.4, "side": 0.3, "theta": 0.4, "align": 0.2}
    strengths |= {"cohesion": 0.3, "pull": 0.4, "dense": 0.3, "friction": 0.4}
    scene = {"hidden": Hidden(**strengths, tiring=0.1), "group": [0, 0, 1, 1, 1, -1]}
    turned = acceleration(x * turn, v * turn, **scene)
    np.testing.assert_allclose(turned, acceleration(x, v, **scene) * turn, rtol=1e-6, atol=1e-6)


def test_motion_as_another_integrator_with_errors_of_fourth_order(monkeypatch):
    # the force of a wall's points is cut off at a distance: use the two distant ends only
    monkeypatch.setattr(motion, "WALL_SPACING", 100.0)
    long = np.array([[-50.0, 0.0, 50.0, 0.0]])
    x = np.array([1j, 3 + 1.3j, 0.5 + 2.5j, 3.2 + 2.4j])
    v = np.array([1.2, -1.1, 1.3, -1]) + np.random.default_rng(5).normal(0, 0.05, (4, 2)) @ [1, 1j]
    goal = x + 30 * (np.sign(v.real) + 1j * np.sign(v.imag))
    hidden = Hidden(align=0.3, A_w=0.3, B_w=0.4, A_2=0.2, dense=0.2)

    def rates(t: float, y: np.ndarray) -> np.ndarray:
        x, v = y.reshape(2, 4)
        walls = np.array([[-50, 50]], complex)
        return np.concatenate([v, acceleration(x, v, SMOOTH, hidden, goal, walls=walls)])

    def walk(step: float) -> np.ndarray:
        steps = round(2.0 / step)
        plane = [np.stack([part.real, part.imag], -1)[None] for part in (x, v, goal)]
        people = People(*plane, np.full((1, 4), -1), np.zeros((1, 4)))
        kick, zero = np.zeros((1, steps + 1, 4, 2)), np.zeros(1)
        return simulate(SMOOTH, hidden, people, long, kick, zero, zero, step, steps)[0][0, -1]

    start = np.concatenate([x, v])
    exact = solve_ivp(rates, (0, 2), start, method="DOP853", rtol=1e-11, atol=1e-11).y[:4, -1]
    error = [np.abs(walk(step) @ [1, 1j] - exact).max() for step in (0.04, 0.02)]
    assert error[1] < 1e-6
    assert 11 < error[0] / error[1] < 22
