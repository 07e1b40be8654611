"""Laws of people that the field uses, against their sources' equations written otherwise."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

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
    """A law of the field, with other values of some parameters."""
    options = model_options(name)
    found = build_model({**options, "desired": desired})
    assert isinstance(found, Crowd)
    with torch.no_grad():
        for own, value in parameters.items():
            getattr(found.terms[0], own).fill_(value)
    return found


def scene(x: Any, v: Any, preferred: Any = None) -> Sequence:
    """People at one moment; they want to walk at 1.3 m/s to the right, if not told otherwise."""
    x, v = np.asarray(x, float), np.asarray(v, float)
    wish = np.tile([1.3, 0.0], (len(x), 1)) if preferred is None else np.asarray(preferred, float)
    return straight(x, v, 2, 0.04, name="a", preferred=wish)


def rates(found: Crowd, item: Sequence) -> np.ndarray:
    """(N, 2): velocities of a law of first order, accelerations of one of second."""
    return np.asarray(following.rates(found, collate([item]))[0, :, -2:])


def force(found: Crowd, item: Sequence) -> np.ndarray:
    """(N, 2) m/s²: what others add."""
    alone = Crowd([found.terms[0].alone()], desired=found.desired)  # type: ignore[union-attr, operator]
    return rates(found, item) - rates(alone, item)


def downhill(potential: Callable[[np.ndarray, np.ndarray], float], item: Sequence) -> list[float]:
    """Minus the gradient of a potential of two people's difference of places, and of velocities."""
    apart = item.x[0, 0] - item.x[0, 1]
    v, h = item.v[0, 0] - item.v[0, 1], 1e-5  # type: ignore[index]
    return [
        -(potential(apart + h * u, v) - potential(apart - h * u, v)) / (2 * h) for u in np.eye(2)
    ]


def crowd(n: int, seed: int, side: float) -> Sequence:
    draw = np.random.default_rng(seed)
    return scene(draw.uniform(0, side, (n, 2)), draw.normal(0, 1, (n, 2)))


# -- collision-free speed model ------------------------------------------------------------------


@pytest.mark.parametrize("s", [0.5, 0.9, 1.6, 2.5])
def test_a_single_file_walks_at_the_speed_of_its_spacing(s: float) -> None:
    line = scene([[s * i, 0.0] for i in range(6)], np.zeros((6, 2)))
    found = rates(model("cfsm", T=1.1, l=0.3), line)
    expected = [min(1.3, max(0.0, (s - 0.3) / 1.1))] * 5 + [1.3]
    np.testing.assert_allclose(found[:, 0], expected, rtol=1e-9)
    np.testing.assert_allclose(found[:, 1], 0, atol=1e-9)


def test_collision_free_speeds_and_directions_by_loops() -> None:
    item, ell, T, a, D = crowd(7, 3, 2.0), 0.35, 0.8, 3.0, 0.2
    found = rates(model("cfsm", T=T, l=ell, a=a, D=D), item)
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
            found[i], min(1.3, max(0, (spacing - ell) / T)) * e, rtol=1e-4, atol=1e-5
        )


def test_who_meets_nobody_walks_as_he_wants() -> None:
    found = rates(model("cfsm"), scene([[0, 0]], [[0.2, 0.9]], [[0.5, 1.2]]))
    np.testing.assert_allclose(found[0], [0.5, 1.2], rtol=1e-3)


def test_nothing_is_added_to_a_law_of_first_order() -> None:
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
    found = [t.real for t in roots if abs(t.imag) < 1e-12 and t.real > 0]
    return min(found, default=math.inf)


def test_the_power_law_is_the_gradient_of_its_energy() -> None:
    k, t0 = 1.5, 3.0
    one = scene([[0, 0], [3.0, 0.2]], [[1.2, 0.1], [-0.9, 0.0]])

    def energy(x: np.ndarray, v: np.ndarray) -> float:
        t = time_to_collision(x, v, 2 * R)
        return k / t**2 * math.exp(-t / t0)

    wanted, found = downhill(energy, one), force(model("ttc", k=k, t0=t0, r=R), one)
    apart, v = one.x[0, 0] - one.x[0, 1], one.v[0, 0] - one.v[0, 1]  # type: ignore[index]
    # the formula's own factor, which takes the infinite force from who would just touch
    inside = (apart @ v) ** 2 - v @ v * (apart @ apart - 4 * R**2)
    np.testing.assert_allclose(found[0] * (inside + 0.01) / inside, wanted, rtol=1e-5)
    np.testing.assert_allclose(found[1], -found[0], rtol=1e-9)


@pytest.mark.parametrize("v", [[[-1.0, 0], [1.0, 0]], [[1.0, 0.9], [-1.0, 0.9]], [[1, 0], [1, 0]]])
def test_who_does_not_collide_feels_no_force(v: Any) -> None:
    start = [[0, 0], [2.0, 0]] if v[0][1] == 0 else [[0, 0], [2.0, 3.0]]
    np.testing.assert_array_equal(force(model("ttc"), scene(start, v)), 0)


# -- generalised centrifugal force ---------------------------------------------------------------


def ellipse(v: np.ndarray, n: np.ndarray, v0: float) -> float:
    """Distance from the centre to the border in a direction, by its polar form."""
    speed = float(np.linalg.norm(v))
    a, b = 0.18 + 0.53 * speed, max(0.25 - 0.05 * speed / v0, 0.2)
    angle = math.atan2(n[1], n[0]) - math.atan2(v[1], v[0])
    return 1 / math.sqrt((math.cos(angle) / a) ** 2 + (math.sin(angle) / b) ** 2)


def test_centrifugal_forces_by_loops() -> None:
    item, eta = crowd(5, 5, 2.5), 0.3
    x, v = item.x[0], item.v[0]  # type: ignore[index]
    wanted = np.zeros((5, 2))
    for i in range(5):
        for j in set(range(5)) - {i}:
            d = math.dist(x[i], x[j])
            e = (x[j] - x[i]) / d
            sees = max(v[i] @ e, 0) / np.linalg.norm(v[i])
            closing = max((v[i] - v[j]) @ e, 0)
            between = max(d - ellipse(v[i], e, 1.3) - ellipse(v[j], -e, 1.3), 0.1)
            near = min(max((2.0 - d) / 0.5, 0), 1)
            wanted[i] -= near * min(sees * (eta * 1.3 + closing) ** 2 / between, 9.0) * e
    assert np.abs(wanted).max() > 0.1
    np.testing.assert_allclose(force(model("gcfm", eta=eta), item), wanted, rtol=1e-4, atol=1e-5)


def test_nobody_is_pushed_from_behind_or_by_who_walks_away() -> None:
    behind = scene([[0, 0], [-0.9, 0.1]], [[1.0, 0], [1.5, 0.0]])
    assert np.abs(force(model("gcfm"), behind)[0]).max() == 0
    away = scene([[0, 0], [0.9, 0.0]], [[1.0, 0], [1.5, 0.0]])
    assert np.abs(force(model("gcfm", eta=0.0), away)).max() < 1e-9


# -- elliptical social force ---------------------------------------------------------------------


def test_the_elliptical_force_is_the_gradient_of_its_potential() -> None:
    A, B, stride, one = 0.8, 0.4, 0.7, scene([[0, 0], [1.1, 0.3]], [[1.2, 0.1], [-0.4, 0.3]])

    def potential(x: np.ndarray, v: np.ndarray) -> float:
        y = -v * stride
        far = np.linalg.norm(x) + np.linalg.norm(x - y)
        return A * B * math.exp((2 * R - math.sqrt(far**2 - y @ y) / 2) / B)

    found = force(model("esf", A=A, B=B, stride=stride, lam=1.0), one)
    np.testing.assert_allclose(found[0], downhill(potential, one), rtol=1e-5)


def test_without_velocities_it_is_circular() -> None:
    item = crowd(5, 8, 3.0)
    item = replace(item, v=np.zeros_like(item.x))
    found, x = force(model("esf", lam=1.0, A=0.7, B=0.5), item), item.x[0]
    for i in range(5):
        apart = np.array([x[i] - x[j] for j in range(5) if j != i])
        d = np.linalg.norm(apart, axis=1)[:, None]
        wanted = (0.7 * np.exp((2 * R - d) / 0.5) * apart / d).sum(0)
        np.testing.assert_allclose(found[i], wanted, rtol=1e-5)
    still = force(model("esf", lam=1.0, A=0.7, B=0.5, stride=0.0), crowd(5, 8, 3.0))
    np.testing.assert_allclose(still, found, rtol=1e-9, atol=1e-9)


# -- walls ---------------------------------------------------------------------------------------

#: A corner, and a wall across it; x1, y1, x2, y2 in m.
WALLS = np.array([[0.0, 0.0, 4.0, 0.0], [0.0, 3.0, 0.0, 0.0], [3.5, 0.5, 1.0, 2.9]])


def nearest(x: np.ndarray, wall: np.ndarray) -> tuple[np.ndarray, bool]:
    """The point of a wall that is nearest, and whether it is one of its ends."""
    share = (x - wall[:2]) @ (wall[2:] - wall[:2]) / ((wall[2:] - wall[:2]) @ (wall[2:] - wall[:2]))
    inside = min(max(share, 0.0), 1.0)
    return wall[:2] + inside * (wall[2:] - wall[:2]), inside != share


def by_walls(name: str, item: Sequence, **parameters: Any) -> np.ndarray:
    """(N, 2): what walls add to the rates."""
    law = {**model_options(name), "desired": "direction"}
    found = rates(build_model(law), replace(item, walls=WALLS))
    bare = build_model({**law, "law": without_walls(PEDESTRIAN_LAWS[name])})
    np.testing.assert_array_equal(
        rates(bare, replace(item, walls=WALLS)), rates(build_model(law), item)
    )
    return found - rates(bare, item)


def near_walls() -> Sequence:
    x = np.array([[0.4, 0.25], [2.2, 0.2], [3.8, 0.4], [1.0, 1.6], [2.4, 1.9], [-0.3, -0.4]])
    draw = np.random.default_rng(2)
    return scene(x, draw.normal(0, 0.8, x.shape))


def test_elliptical_walls_are_exponential() -> None:
    item = near_walls()
    wanted = np.zeros((6, 2))
    for i, x in enumerate(item.x[0]):
        for wall in WALLS:
            away = x - nearest(x, wall)[0]
            d = np.linalg.norm(away)
            wanted[i] += 5.0 * math.exp((R - d) / 0.1) * away / d
    assert np.abs(wanted).max() > 1
    np.testing.assert_allclose(by_walls("esf", item), wanted, rtol=1e-6, atol=1e-9)


def test_centrifugal_walls_push_those_who_come_along_their_normal() -> None:
    item = near_walls()
    x, v = item.x[0], item.v[0]  # type: ignore[index]
    wanted = np.zeros((6, 2))
    for i in range(6):
        for wall in WALLS:
            point, end = nearest(x[i], wall)
            d = math.dist(x[i], point)
            e = (point - x[i]) / d
            if end:
                continue
            sees = max(v[i] @ e, 0) / np.linalg.norm(v[i])
            room = max(d - ellipse(v[i], e, 1.3), 0.1)
            near = min(max((2.0 - d) / 0.5, 0), 1)
            wanted[i] -= near * min(sees * (0.2 * 1.3 + max(v[i] @ e, 0)) ** 2 / room, 3.0) * e
    assert np.abs(wanted).max() > 0.5
    assert (wanted[5] == 0).all()  # beyond the corner
    np.testing.assert_allclose(by_walls("gcfm", item), wanted, rtol=1e-4, atol=1e-6)


def test_collision_free_people_turn_from_walls() -> None:
    lone = scene([[2.2, 0.17]], [[1.0, 0.0]])
    found = rates(model("cfsm"), replace(lone, walls=WALLS))[0]
    way = np.array([1.0, 5.0 * math.exp((0.15 - 0.17) / 0.02)])
    np.testing.assert_allclose(found, 1.3 * way / np.linalg.norm(way), rtol=1e-5)


# -- what people want ----------------------------------------------------------------------------


def test_directions_are_those_of_streams() -> None:
    wish = [[1.0, 0.2], [1.4, -0.2], [-1.1, 0.0], [math.nan, math.nan], [0, 0]]
    item = scene(np.arange(10.0).reshape(5, 2), [[9, 9]] * 3 + [[-0.9, 0.2], [1, 1]], wish)
    found = rates(model("cfsm", a=0.0, l=0.05), item)
    # the fourth was not measured before and takes his velocity at the start; the fifth stood
    np.testing.assert_allclose(found[0], [math.hypot(1.0, 0.2), 0], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found[1], [math.hypot(1.4, 0.2), 0], rtol=1e-6, atol=1e-6)
    back = np.array([-2.0, 0.2]) / math.hypot(2.0, 0.2)
    np.testing.assert_allclose(found[2], 1.1 * back, rtol=1e-6)
    np.testing.assert_allclose(found[3], math.hypot(0.9, 0.2) * back, rtol=1e-6)
    np.testing.assert_allclose(found[4], 0, atol=1e-9)


def test_exits_must_be_told() -> None:
    item = scene([[0, 0], [5, 0]], [[1, 0], [1, 0]])
    with pytest.raises(DataError, match="destinations"):
        rates(model("cfsm", "exit"), item)
    told = replace(item, destination=np.array([[0.0, 9.0], [5.0, -9.0]]))
    found = rates(model("cfsm", "exit", a=0.0), told)
    np.testing.assert_allclose(found, [[0, 1.3], [0, -1.3]], atol=1e-9)


def test_the_paper_s_drive_takes_the_preferred_speed_with_a_direction() -> None:
    item = scene([[0, 0], [50, 0]], [[0.4, 0.3], [0.4, 0.3]])
    options = {**model_options("sf", "measured"), "name": "sf"}
    found = [
        rates(build_model({**options, "A": 0.0, "k": 0.0, "kappa": 0.0, "desired": d}), item)[0]  # type: ignore[arg-type]
        for d in ("last", "direction")
    ]
    np.testing.assert_allclose(found[0], 0, atol=1e-4)
    np.testing.assert_allclose(found[1], [(1.3 - 0.4) / 0.5, -0.3 / 0.5], rtol=1e-5)
