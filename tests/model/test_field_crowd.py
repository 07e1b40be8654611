"""Published pedestrian laws against their sources' equations."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from nnode.app.python.inputs import model_options
from nnode.data.sequence import Sequence, collate
from nnode.errors import ConfigError, DataError
from nnode.model import Crowd, build_model
from nnode.model.laws import PEDESTRIAN_LAWS
from studies.walking.tasks import without_walls
from tests.builders import straight
from tests.model import following

R = 0.25


def model(name: str, desired: str = "direction", **parameters: Any) -> Crowd:
    """A law of the catalogue with other values of some parameters."""
    return following.set_(build_model({**model_options(name), "desired": desired}), **parameters)


def scene(x: Any, v: Any, preferred: Any = None) -> Sequence:
    """People at one moment, who by default prefer to walk at 1.3 m/s to the right."""
    x, v = np.asarray(x, float), np.asarray(v, float)
    preferred = np.tile([1.3, 0.0], (len(x), 1)) if preferred is None else preferred
    return straight(x, v, 2, 0.04, name="a", preferred=np.asarray(preferred, float))


def rates(system: Crowd, item: Sequence) -> np.ndarray:
    """(N, 2): velocities of a law of first order, accelerations of a law of second order."""
    return np.asarray(following.rates(system, collate([item]))[0, :, -2:])


def force(system: Crowd, item: Sequence) -> np.ndarray:
    """(N, 2) m/s²: the interaction with others."""
    alone = Crowd([system.terms[0].alone()], desired=system.desired)
    return rates(system, item) - rates(alone, item)


def downhill(potential: Callable[[np.ndarray, np.ndarray], float], item: Sequence) -> list[float]:
    """Minus the gradient of a potential of relative position and relative velocity."""
    apart = item.x[0, 0] - item.x[0, 1]
    v, h = item.v[0, 0] - item.v[0, 1], 1e-5
    return [
        -(potential(apart + h * u, v) - potential(apart - h * u, v)) / (2 * h) for u in np.eye(2)
    ]


def crowd(n: int, seed: int, side: float) -> Sequence:
    draw = np.random.default_rng(seed)
    return scene(draw.uniform(0, side, (n, 2)), draw.normal(0, 1, (n, 2)))


# -- collision-free speed model ------------------------------------------------------------------


@pytest.mark.parametrize("s", [0.5, 0.9, 1.6, 2.5])
def test_speed_by_spacing_in_single_file(s: float) -> None:
    line = scene([[s * i, 0.0] for i in range(6)], np.zeros((6, 2)))
    velocity = rates(model("cfsm", T=1.1, l=0.3), line)
    expected = [min(1.3, max(0.0, (s - 0.3) / 1.1))] * 5 + [1.3]
    np.testing.assert_allclose(velocity[:, 0], expected, rtol=1e-9)
    np.testing.assert_allclose(velocity[:, 1], 0, atol=1e-9)


def test_collision_free_velocities_by_loops() -> None:
    item, ell, T, a, D = crowd(7, 3, 2.0), 0.35, 0.8, 3.0, 0.2
    velocity = rates(model("cfsm", T=T, l=ell, a=a, D=D), item)
    x = item.x[0]
    for i in range(7):
        e = np.array([1.0, 0.0])
        for j in set(range(7)) - {i}:
            s = math.dist(x[i], x[j])
            e = e + a * math.exp((ell - s) / D) * (x[i] - x[j]) / s
        e /= np.linalg.norm(e)
        spacing = math.inf
        for j in set(range(7)) - {i}:
            s = math.dist(x[i], x[j])
            to = (x[j] - x[i]) / s
            if to @ e >= 0 and abs(to @ [-e[1], e[0]]) <= ell / s:
                spacing = min(spacing, s)
        np.testing.assert_allclose(
            velocity[i], min(1.3, max(0, (spacing - ell) / T)) * e, rtol=1e-4, atol=1e-5
        )


def test_preferred_velocity_of_one_person() -> None:
    velocity = rates(model("cfsm"), scene([[0, 0]], [[0.2, 0.9]], [[0.5, 1.2]]))
    np.testing.assert_allclose(velocity[0], [0.5, 1.2], rtol=1e-3)


def test_effects_do_not_apply_to_laws_of_first_order() -> None:
    options = model_options("cfsm")
    with pytest.raises(ConfigError, match="first order"):
        build_model({**options, "effects": [{"name": "anticipation"}]})
    law = {**PEDESTRIAN_LAWS["cfsm"], "rate": {"x": "V*e_x", "y": "0*V"}}
    with pytest.raises(ConfigError, match="cannot name vx"):
        build_model({**options, "law": law})


# -- time to collision ---------------------------------------------------------------------------


def time_to_collision(x: np.ndarray, v: np.ndarray, radius: float) -> float:
    """Smallest positive time at which |x + v t| is the radius."""
    roots = np.roots([v @ v, 2 * x @ v, x @ x - radius**2])
    return min((t.real for t in roots if abs(t.imag) < 1e-12 and t.real > 0), default=math.inf)


def test_power_law_is_the_gradient_of_its_energy() -> None:
    k, t0 = 1.5, 3.0
    pair = scene([[0, 0], [3.0, 0.2]], [[1.2, 0.1], [-0.9, 0.0]])

    def energy(x: np.ndarray, v: np.ndarray) -> float:
        t = time_to_collision(x, v, 2 * R)
        return k / t**2 * math.exp(-t / t0)

    simulated = force(model("ttc", k=k, t0=t0, r=R), pair)
    apart, v = pair.x[0, 0] - pair.x[0, 1], pair.v[0, 0] - pair.v[0, 1]
    # the law's factor against infinite forces of people who would just touch
    inside = (apart @ v) ** 2 - v @ v * (apart @ apart - 4 * R**2)
    expected = downhill(energy, pair)
    np.testing.assert_allclose(simulated[0] * (inside + 0.01) / inside, expected, rtol=1e-5)
    np.testing.assert_allclose(simulated[1], -simulated[0], rtol=1e-9)


@pytest.mark.parametrize("v", [[[-1.0, 0], [1.0, 0]], [[1.0, 0.9], [-1.0, 0.9]], [[1, 0], [1, 0]]])
def test_no_force_without_a_collision(v: Any) -> None:
    start = [[0, 0], [2.0, 0]] if v[0][1] == 0 else [[0, 0], [2.0, 3.0]]
    np.testing.assert_array_equal(force(model("ttc"), scene(start, v)), 0)


# -- generalised centrifugal force ---------------------------------------------------------------


def ellipse(v: np.ndarray, n: np.ndarray, v0: float) -> float:
    """Distance from the centre to the border in a direction, by its polar form."""
    speed = float(np.linalg.norm(v))
    a, b = 0.18 + 0.53 * speed, max(0.25 - 0.05 * speed / v0, 0.2)
    angle = math.atan2(n[1], n[0]) - math.atan2(v[1], v[0])
    return 1 / math.sqrt((math.cos(angle) / a) ** 2 + (math.sin(angle) / b) ** 2)


def centrifugal(
    v: np.ndarray, closing: float, e: np.ndarray, d: float, gap: float, eta: float, limit: float
) -> np.ndarray:
    """The force of a person or a wall in direction e at distance d, with a gap of ellipses."""
    sees = max(v @ e, 0) / np.linalg.norm(v)
    near = min(max((2.0 - d) / 0.5, 0), 1)
    return -near * min(sees * (eta * 1.3 + max(closing, 0)) ** 2 / max(gap, 0.1), limit) * e


def test_centrifugal_forces_by_loops() -> None:
    item, eta = crowd(5, 5, 2.5), 0.3
    x, v = item.x[0], item.v[0]
    expected = np.zeros((5, 2))
    for i in range(5):
        for j in set(range(5)) - {i}:
            d = math.dist(x[i], x[j])
            e = (x[j] - x[i]) / d
            gap = d - ellipse(v[i], e, 1.3) - ellipse(v[j], -e, 1.3)
            expected[i] += centrifugal(v[i], (v[i] - v[j]) @ e, e, d, gap, eta, 9.0)
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(force(model("gcfm", eta=eta), item), expected, rtol=1e-4, atol=1e-5)


def test_no_centrifugal_force_from_behind_or_of_people_who_walk_away() -> None:
    behind = scene([[0, 0], [-0.9, 0.1]], [[1.0, 0], [1.5, 0.0]])
    assert np.abs(force(model("gcfm"), behind)[0]).max() == 0
    away = scene([[0, 0], [0.9, 0.0]], [[1.0, 0], [1.5, 0.0]])
    assert np.abs(force(model("gcfm", eta=0.0), away)).max() < 1e-9


# -- elliptical social force ---------------------------------------------------------------------


def test_elliptical_force_is_the_gradient_of_its_potential() -> None:
    A, B, stride = 0.8, 0.4, 0.7
    pair = scene([[0, 0], [1.1, 0.3]], [[1.2, 0.1], [-0.4, 0.3]])

    def potential(x: np.ndarray, v: np.ndarray) -> float:
        y = -v * stride
        far = np.linalg.norm(x) + np.linalg.norm(x - y)
        return A * B * math.exp((2 * R - math.sqrt(far**2 - y @ y) / 2) / B)

    simulated = force(model("esf", A=A, B=B, stride=stride, lam=1.0), pair)
    np.testing.assert_allclose(simulated[0], downhill(potential, pair), rtol=1e-5)


def test_elliptical_force_without_velocities_is_circular() -> None:
    moving = crowd(5, 8, 3.0)
    still = replace(moving, v=np.zeros_like(moving.x))
    simulated, x = force(model("esf", lam=1.0, A=0.7, B=0.5), still), still.x[0]
    for i in range(5):
        apart = np.array([x[i] - x[j] for j in range(5) if j != i])
        d = np.linalg.norm(apart, axis=1)[:, None]
        expected = (0.7 * np.exp((2 * R - d) / 0.5) * apart / d).sum(0)
        np.testing.assert_allclose(simulated[i], expected, rtol=1e-5)
    without_stride = force(model("esf", lam=1.0, A=0.7, B=0.5, stride=0.0), moving)
    np.testing.assert_allclose(without_stride, simulated, rtol=1e-9, atol=1e-9)


# -- walls ---------------------------------------------------------------------------------------

#: A corner, and a wall across it; x1, y1, x2, y2 in m.
WALLS = np.array([[0.0, 0.0, 4.0, 0.0], [0.0, 3.0, 0.0, 0.0], [3.5, 0.5, 1.0, 2.9]])


def nearest(x: np.ndarray, wall: np.ndarray) -> tuple[np.ndarray, bool]:
    """The nearest point of a wall, and whether it is an end of the wall."""
    share = (x - wall[:2]) @ (wall[2:] - wall[:2]) / ((wall[2:] - wall[:2]) @ (wall[2:] - wall[:2]))
    inside = min(max(share, 0.0), 1.0)
    return wall[:2] + inside * (wall[2:] - wall[:2]), inside != share


def by_walls(name: str, item: Sequence) -> np.ndarray:
    """(N, 2): the effect of walls on the rates."""
    walled = replace(item, walls=WALLS)
    options = {**model_options(name), "desired": "direction"}
    bare = build_model({**options, "law": without_walls(PEDESTRIAN_LAWS[name])})
    open_space = rates(model(name), item)
    np.testing.assert_array_equal(rates(bare, walled), open_space)
    return rates(model(name), walled) - open_space


def near_walls() -> Sequence:
    x = np.array([[0.4, 0.25], [2.2, 0.2], [3.8, 0.4], [1.0, 1.6], [2.4, 1.9], [-0.3, -0.4]])
    draw = np.random.default_rng(2)
    return scene(x, draw.normal(0, 0.8, x.shape))


def test_elliptical_wall_force_by_loops() -> None:
    item = near_walls()
    expected = np.zeros((6, 2))
    for i, x in enumerate(item.x[0]):
        for wall in WALLS:
            away = x - nearest(x, wall)[0]
            d = np.linalg.norm(away)
            expected[i] += 5.0 * math.exp((R - d) / 0.1) * away / d
    assert np.abs(expected).max() > 1
    np.testing.assert_allclose(by_walls("esf", item), expected, rtol=1e-6, atol=1e-9)


def test_centrifugal_wall_force_by_loops() -> None:
    item = near_walls()
    x, v = item.x[0], item.v[0]
    expected = np.zeros((6, 2))
    for i in range(6):
        for wall in WALLS:
            point, end = nearest(x[i], wall)
            if not end:
                d = math.dist(x[i], point)
                e = (point - x[i]) / d
                gap = d - ellipse(v[i], e, 1.3)
                expected[i] += centrifugal(v[i], v[i] @ e, e, d, gap, 0.2, 3.0)
    assert np.abs(expected).max() > 0.5
    assert (expected[5] == 0).all()  # beyond the corner
    np.testing.assert_allclose(by_walls("gcfm", item), expected, rtol=1e-4, atol=1e-6)


def test_collision_free_direction_near_a_wall() -> None:
    person = scene([[2.2, 0.17]], [[1.0, 0.0]])
    way = np.array([1.0, 5.0 * math.exp((0.15 - 0.17) / 0.02)])
    velocity = rates(model("cfsm"), replace(person, walls=WALLS))[0]
    np.testing.assert_allclose(velocity, 1.3 * way / np.linalg.norm(way), rtol=1e-5)


# -- desired velocities --------------------------------------------------------------------------


def test_desired_directions_are_those_of_streams() -> None:
    preferred = [[1.0, 0.2], [1.4, -0.2], [-1.1, 0.0], [math.nan, math.nan], [0, 0]]
    item = scene(np.arange(10.0).reshape(5, 2), [[9, 9]] * 3 + [[-0.9, 0.2], [1, 1]], preferred)
    # the fourth person has no earlier measurement, only a start velocity; the fifth stood
    back = np.array([-2.0, 0.2]) / math.hypot(2.0, 0.2)
    expected = [
        [math.hypot(1.0, 0.2), 0],
        [math.hypot(1.4, 0.2), 0],
        1.1 * back,
        math.hypot(0.9, 0.2) * back,
        [0, 0],
    ]
    velocities = rates(model("cfsm", a=0.0, l=0.05), item)
    np.testing.assert_allclose(velocities[:2], expected[:2], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(velocities[2:4], expected[2:4], rtol=1e-6)
    np.testing.assert_allclose(velocities[4], 0, atol=1e-9)


def test_desired_exit_needs_destinations() -> None:
    item = scene([[0, 0], [5, 0]], [[1, 0], [1, 0]])
    with pytest.raises(DataError, match="destinations"):
        rates(model("cfsm", "exit"), item)
    with_exits = replace(item, destination=np.array([[0.0, 9.0], [5.0, -9.0]]))
    velocities = rates(model("cfsm", "exit", a=0.0), with_exits)
    np.testing.assert_allclose(velocities, [[0, 1.3], [0, -1.3]], atol=1e-9)


def test_relaxation_to_the_preferred_velocity() -> None:
    item = scene([[0, 0], [50, 0]], [[0.4, 0.3], [0.4, 0.3]])
    options = {**model_options("sf", "measured"), "name": "sf", "A": 0.0, "k": 0.0, "kappa": 0.0}
    last, direction = (
        rates(build_model({**options, "desired": desired}), item)[0]
        for desired in ("last", "direction")
    )
    np.testing.assert_allclose(last, 0, atol=1e-4)
    np.testing.assert_allclose(direction, [(1.3 - 0.4) / 0.5, -0.3 / 0.5], rtol=1e-5)
