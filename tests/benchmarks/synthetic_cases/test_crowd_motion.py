"""People move as the formulas say: closed forms, symmetry, and another integrator."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from benchmarks.synthetic_cases.crowd.motion import Base, Hidden, accelerations, simulate

BASE = Base(A=16.0, k=400.0, kappa=20.0)
FREE = Base(A=0.0, k=0.0, kappa=0.0)
WALL = np.array([[-5.0, 0.0, 5.0, 0.0]])


def acceleration(
    x,
    v,
    *,
    base=FREE,
    hidden=None,
    goal=None,
    group=None,
    points=None,
    walls=None,
    clock=0.0,
    phase=0.0,
    eta=0.0,
    since=0.0,
):
    """``(N, 2)`` m/s² of people who, where nothing else is said, steer straight on."""
    x, v = np.array(x, dtype=float), np.array(v, dtype=float)
    out = np.empty_like(x)
    accelerations(
        base,
        hidden or Hidden(),
        x,
        v,
        x + 1e6 * v if goal is None else np.array(goal, float),
        np.full(len(x), -1) if group is None else np.array(group),
        np.full(len(x), eta),
        np.full(len(x), phase),
        np.empty((0, 2)) if points is None else np.array(points, float),
        np.empty((0, 4)) if walls is None else walls,
        clock,
        since,
        out,
    )
    return out


def test_relaxation_turns_to_the_destination_at_the_present_speed():
    found = acceleration([[0, 0]], [[1.5, 0]], goal=[[0, 100]])
    np.testing.assert_allclose(found, [[-3.0, 3.0]])
    eager = acceleration([[0, 0]], [[1.5, 0]], goal=[[0, 100]], eta=0.5)
    np.testing.assert_allclose(eager, 1.5 * found)


def test_two_people_repel_each_other_as_the_social_force_says():
    x, v = [[0, 0], [1, 0]], [[1, 0], [1, 0]]
    push = 16.0 * np.exp((0.5 - 1.0) / 0.3) / 2
    np.testing.assert_allclose(acceleration(x, v, base=BASE), [[-push, 0], [push, 0]])
    # in contact, sliding past each other
    found = acceleration([[0, 0], [0.4, 0]], [[0, 1], [0, -1]], base=BASE)
    push = (16.0 * np.exp(0.1 / 0.3) + 400 * 0.1) / 2
    np.testing.assert_allclose(found, [[-push, -20 * 0.1 * 2 / 2], [push, 20 * 0.1 * 2 / 2]])


def test_wall_points_count_by_their_mean():
    points = [[0, 0], [100, 0], [200, 0], [300, 0]]
    found = acceleration([[0, 0.5]], [[1, 0]], base=BASE, points=points)
    np.testing.assert_allclose(found, [[0, 16.0 * np.exp((0.25 - 0.5) / 0.3) / 4]], atol=1e-12)


X, V = [[0.0, 0.0], [1.2, 0.0]], [[1.0, 0.0], [-1.0, 0.0]]
PAIR = 16.0 * np.exp((0.5 - 1.2) / 0.3) / 2


@pytest.mark.parametrize(
    ("hidden", "first"),
    [
        (Hidden(A_2=0.5, B_2=0.8), (-0.5 * np.exp(-0.7 / 0.8), 0.0)),
        (Hidden(side=0.4), (0.0, -0.4 * (1 - np.exp(-1 / (1 + np.exp(-6.0)))))),
        (Hidden(align=0.3), (-0.6, 0.0)),
        (Hidden(a_x=0.2, a_y=-0.1), (0.2, -0.1)),
        (Hidden(pull=0.5, v_pref=1.4), (0.2, 0.0)),
        (Hidden(dense=0.5), (-0.5 * np.exp(-0.72) / (2 * np.pi), 0.0)),
        (Hidden(sway=0.8, sway_f=1.0), (0.0, -0.8)),
        (Hidden(A_o=2.0, B_o=0.5, x_o=0.0, y_o=-1.0), (0.0, 2.0 * np.exp(-2.0))),
        (Hidden(A_o=2.0, B_o=0.5, x_o=0.0, y_o=-1.0, bell=1.0), (0.0, 2.0 * np.exp(-2.0))),
        (Hidden(tiring=0.1), (-0.2, 0.0)),
        (Hidden(push=0.3, push_T=1.0), (0.0, 0.3)),
    ],
)
def test_effects_are_what_their_formulas_say(hidden, first):
    found = acceleration(X, V, hidden=hidden, clock=0.25, since=2.0)
    np.testing.assert_allclose(found[0], first, atol=1e-9)


def test_effects_on_the_pair_force_change_it_alone():
    # the first sees the other straight ahead, the other is overtaken from behind
    v = [[1.0, 0.0], [0.5, 0.0]]
    seen = acceleration(X, v, base=BASE, hidden=Hidden(lambda_=0.2))
    np.testing.assert_allclose(seen, [[-PAIR, 0], [0.2 * PAIR, 0]], atol=1e-12)
    soon = acceleration(X, V, base=BASE, hidden=Hidden(T_a=0.2))
    np.testing.assert_allclose(soon[0], [-16.0 * np.exp((0.5 - 0.8) / 0.3) / 2, 0], atol=1e-12)
    turned = acceleration(X, V, base=BASE, hidden=Hidden(theta=0.5))
    np.testing.assert_allclose(turned[0], [-PAIR * np.cos(0.5), -PAIR * np.sin(0.5)])
    same_way = acceleration(X, v, base=BASE, hidden=Hidden(theta=0.5))
    np.testing.assert_allclose(same_way[0], [-PAIR, 0], atol=1e-12)


def test_friction_acts_along_the_tangent():
    hidden = Hidden(friction=0.6)
    found = acceleration([[0, 0], [0, 1]], [[1, 0], [-1, 0]], hidden=hidden)
    np.testing.assert_allclose(found[0], [-1.2 * np.exp(-1.0), 0], atol=1e-12)


def test_groups_draw_together():
    x, v = [[0, 0], [0, 1], [2, 0], [3, 3]], [[1, 0]] * 4
    found = acceleration(x, v, hidden=Hidden(cohesion=0.5), group=[0, 0, 0, -1])
    np.testing.assert_allclose(found[0], [0.5, 0.25])
    np.testing.assert_allclose(found[3], 0, atol=1e-9)


def test_walls_repel_from_their_nearest_point():
    hidden = Hidden(A_w=0.5, B_w=0.4)
    beside = acceleration([[1, 0.65]], [[1, 0]], hidden=hidden, walls=WALL)
    np.testing.assert_allclose(beside, [[0, 0.5 * np.exp(-1.0)]], atol=1e-9)
    beyond = acceleration([[8, 4]], [[1, 0]], hidden=hidden, walls=WALL)
    np.testing.assert_allclose(beyond[0], 0.5 * np.exp((0.25 - 5) / 0.4) * np.array([0.6, 0.8]))


def test_turning_the_scene_turns_the_accelerations():
    rng = np.random.default_rng(4)
    x, v = rng.uniform(0, 4, (6, 2)), rng.normal(0, 1, (6, 2))
    hidden = Hidden(
        A_2=0.3,
        lambda_=0.3,
        T_a=0.4,
        side=0.3,
        theta=0.4,
        align=0.2,
        cohesion=0.3,
        pull=0.4,
        dense=0.3,
        friction=0.4,
        sway=0.5,
        tiring=0.1,
    )
    a = 0.7
    turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    group = [0, 0, 1, 1, 1, -1]
    there = acceleration(x, v, base=BASE, hidden=hidden, group=group)
    turned = acceleration(x @ turn.T, v @ turn.T, base=BASE, hidden=hidden, group=group)
    np.testing.assert_allclose(turned, there @ turn.T, rtol=1e-6, atol=1e-6)


# contacts have a kink, at which no method keeps its order
SMOOTH = Base(A=16.0, k=0.0, kappa=0.0)


def walk(step: float, hidden: Hidden, x, v, goal):
    n = len(x)
    return simulate(
        SMOOTH,
        hidden,
        x[None],
        v[None],
        goal[None],
        np.full((1, n), -1),
        np.zeros((1, n)),
        np.zeros((1, n)),
        np.empty((0, 2)),
        WALL,
        np.zeros((1, 1, n, 2)),
        np.zeros(1),
        np.zeros(1),
        step,
        round(2.0 / step),
        round(2.0 / step),
    )[0][0, -1]


def test_another_integrator_finds_the_same_motion_and_errors_fall_sixteenfold():
    rng = np.random.default_rng(5)
    x = np.array([[0.0, 1], [3.0, 1.3], [0.5, 2.5], [3.2, 2.4]])
    v = np.array([[1.2, 0], [-1.1, 0], [1.3, 0], [-1.0, 0]]) + rng.normal(0, 0.05, (4, 2))
    goal = x + 30 * np.sign(v)
    hidden = Hidden(align=0.3, A_w=0.3, B_w=0.4, A_2=0.2, dense=0.2)

    def rates(t: float, y: np.ndarray) -> np.ndarray:
        x, v = y.reshape(2, 4, 2)
        a = acceleration(x, v, base=SMOOTH, hidden=hidden, goal=goal, walls=WALL)
        return np.concatenate([v.ravel(), a.ravel()])

    start = np.concatenate([x.ravel(), v.ravel()])
    exact = solve_ivp(rates, (0, 2), start, method="DOP853", rtol=1e-11, atol=1e-11).y[:8, -1]
    error = [np.abs(walk(h, hidden, x, v, goal).ravel() - exact).max() for h in (0.04, 0.02)]
    assert error[1] < 1e-6
    assert 11 < error[0] / error[1] < 22
