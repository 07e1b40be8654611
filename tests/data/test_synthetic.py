"""Synthetic recordings: their laws, their formats, and reproducible files."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import scipy.io

import nnode.data.synthetic
from nnode.data.synthetic import (
    Forces,
    SlowZone,
    crowd_recording,
    demo_data,
    platoon_table,
    social_force,
    traffic_recording,
)


def platoons(path: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    cell = scipy.io.loadmat(path)["sequences"]
    return [(item["Xarr"][0, 0], item["Tarr"][0, 0]) for item in cell.ravel()]


def test_last_gap_has_its_analytic_solution(tmp_path: Path) -> None:
    # behind a leader at v0: g' = v0 L / g, so that g² = g0² + 2 v0 L t
    for x, t in platoons(traffic_recording(tmp_path / "a.mat", seed=0, v0=22.0, L=7.0)):
        gap = x[-1] - x[-2]
        np.testing.assert_allclose(gap**2, gap[0] ** 2 + 2 * 22.0 * 7.0 * (t - t[0, 0])[0])
        np.testing.assert_allclose(x[-1], x[-1, 0] + 22.0 * (t - t[0, 0])[0])


def test_speed_follows_from_the_gap(tmp_path: Path) -> None:
    for x, _ in platoons(traffic_recording(tmp_path / "a.mat", seed=1, v0=20.0, L=5.0)):
        speed = 20.0 * (1 - 5.0 / np.diff(x, axis=0))
        # Simpson's rule over two intervals of 0.2 s
        driven = 0.2 / 3 * (speed[:, :-2] + 4 * speed[:, 1:-1] + speed[:, 2:])
        np.testing.assert_allclose(x[:-1, 2:] - x[:-1, :-2], driven, atol=1e-3)


def test_platoons_are_like_the_published_ones(tmp_path: Path) -> None:
    recorded = platoons(traffic_recording(tmp_path / "a.mat", seed=3))
    assert len(recorded) == 40
    assert {x.shape[0] for x, _ in recorded} == {3, 4, 5, 6}
    for x, t in recorded:
        assert x.dtype == t.dtype == np.float64
        assert t.shape == (1, x.shape[1])
        np.testing.assert_allclose(np.diff(t), 0.2)
        assert 3.0 - 0.11 <= t[0, -1] - t[0, 0] <= 8.0 + 0.11
        assert (np.diff(x[:, 0]) >= 10.0).all()
        assert (np.diff(x[:, 0]) <= 40.0).all()
        assert (np.diff(x, axis=0) > 0).all()
        assert (x > 0).all()
    pauses = [b[1][0, 0] - a[1][0, -1] for a, b in pairwise(recorded)]
    assert min(pauses) == pytest.approx(10.0)


def test_standard_deviation_of_noise(tmp_path: Path) -> None:
    clean, noisy = (
        platoons(traffic_recording(tmp_path / "a.mat", seed=5, noise=noise))[0][0]
        for noise in (0.0, 0.5)
    )
    error = noisy - clean
    # 5 standard deviations of the sample's standard deviation
    assert error.std() == pytest.approx(0.5, abs=5 * 0.5 / math.sqrt(2 * error.size))


# the paper's table: positions and velocities of blue and red, force on blue
SETTINGS = [
    ((0, 0.22), (0, -0.22), (0, -1), (0, 1), (0, 2.1118)),
    ((0, 0.22), (0, -0.22), (0, 1), (0, 1), (0, 2.1118)),
    ((0.01, 0.22), (-0.01, -0.22), (0, -1), (0, 1), (0.0417, 2.0961)),
    ((0.01, 0.22), (-0.01, -0.22), (0, 1), (0, 1), (0.0952, 2.0936)),
    ((0.22, 0), (-0.22, 0), (0, -1), (0, 1), (2.1118, 1.1867)),
    ((0.22, 0), (-0.22, 0), (0, 1), (0, 1), (2.1118, 0)),
]


@pytest.mark.parametrize(("x_blue", "x_red", "v_blue", "v_red", "force"), SETTINGS)
def test_pair_force_of_the_paper(
    x_blue: Any, x_red: Any, v_blue: Any, v_red: Any, force: Any
) -> None:
    forces = Forces(A=0.0044, k=34.9539, kappa=9.8894)
    offset, slip = np.subtract(x_blue, x_red), np.subtract(v_red, v_blue)
    on_blue = social_force(offset.astype(float), slip.astype(float), 0.5, forces)
    on_red = social_force(-offset.astype(float), -slip.astype(float), 0.5, forces)
    np.testing.assert_allclose(on_blue, force, atol=1e-4)
    np.testing.assert_allclose(on_red, np.negative(force), atol=1e-4)


def paper_acceleration(
    x: np.ndarray, v: np.ndarray, goal: np.ndarray, wall: np.ndarray, p: Forces
) -> np.ndarray:
    """The paper's equations as sums over people and wall points."""
    result = np.zeros_like(x)
    for i in range(len(x)):
        offset = goal[i] - x[i]
        desired = offset / math.hypot(*offset) * math.hypot(*v[i])
        result[i] = (desired - v[i]) / p.tau
        partners = [(x[j], v[j] - v[i], 2 * p.r, len(x)) for j in range(len(x)) if j != i]
        for other, slip, reach, count in partners + [(w, v[i], p.r, len(wall)) for w in wall]:
            d = math.dist(x[i], other)
            n = (x[i] - other) / d
            t = np.array([-n[1], n[0]])
            h = max(reach - d, 0.0)
            force = (p.A * math.exp((reach - d) / p.B) + p.k * h) * n + p.kappa * h * (slip @ t) * t
            result[i] += force / (p.mass * count)
    return result


@pytest.mark.thorough
def test_accelerations_follow_the_paper(tmp_path: Path) -> None:
    rate, width = 200.0, 1.2
    forces = Forces(A=3.0, B=0.2)  # the force changes little between two frames
    path = crowd_recording(
        tmp_path / "c.txt",
        seed=3,
        forces=forces,
        people=2,
        duration=7.0,
        length=6.0,
        width=width,
        frame_rate=rate,
        mixing=1.0,
        noise=0.0,
    )
    table = np.loadtxt(path)
    first, second = people = [table[table[:, 0] == i] for i in (1, 2)]
    shared = np.intersect1d(first[:, 1], second[:, 1])
    x = np.stack([rows[np.isin(rows[:, 1], shared)][:, 2:4] / 100 for rows in people], axis=1)
    heading = np.sign(x[-1, :, 0] - x[0, :, 0])
    # straight ahead of the position at which a person enters
    goal = np.column_stack([heading * (3.0 + 1.0 + 5.0), [rows[0, 3] / 100 for rows in people]])
    wall = np.array([(a, b) for b in (0.0, width) for a in np.linspace(-4.0, 4.0, 33)])
    step = 4  # positions have a resolution of 10 µm
    h = step / rate
    k = np.argmin(np.linalg.norm(x[:, 0] - x[:, 1], axis=1))
    assert math.dist(*x[k]) < 0.6
    largest = 0.0
    for i in range(k - 30, k + 30, 6):
        v = (x[i + step] - x[i - step]) / (2 * h)
        a = (x[i + step] - 2 * x[i] + x[i - step]) / h**2
        expected = paper_acceleration(x[i], v, goal, wall, forces)
        np.testing.assert_allclose(a, expected, atol=0.08)
        largest = max(largest, float(np.abs(expected).max()))
    assert largest > 5.0


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return demo_data(tmp_path_factory.mktemp("demo"))


@pytest.mark.thorough
def test_demo_has_the_layout_of_the_real_data(demo: dict[str, Path]) -> None:
    assert demo["esimas"].parts[-2:] == ("esimas", "sequence_datademo.mat")
    assert demo["juelich"].parts[-2:] == ("juelich", "demo_corridor.txt")
    header = demo["juelich"].read_text().splitlines()[:3]
    assert all(line.startswith("#") for line in header)
    assert "# framerate: 25 fps" in header


def test_people_cross_the_corridor_in_both_directions(demo: dict[str, Path]) -> None:
    table = np.loadtxt(demo["juelich"])
    person, frame = table[:, 0], table[:, 1]
    x, y = table[:, 2] / 100, table[:, 3] / 100
    assert np.abs(x).max() <= 5.01
    assert y.min() > 0
    assert y.max() < 4
    distances = []
    for number in np.unique(person):
        assert (np.diff(frame[person == number]) == 1).all()
        path = x[person == number]
        distances.append(path[-1] - path[0])
    assert len(distances) == 45
    assert sum(d > 9 for d in distances) >= 15
    assert sum(d < -9 for d in distances) >= 15
    assert np.bincount(frame.astype(int)).max() >= 10
    assert 25 <= np.ptp(frame) / 25 <= 36


@pytest.mark.thorough
def test_same_seed_gives_the_same_files(
    tmp_path: Path, demo: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    # fewer people for a shorter time draw the same kinds of random numbers
    few = partial(crowd_recording, people=6, duration=4.0)
    monkeypatch.setattr(
        nnode.data.synthetic, "crowd_recording", lambda path, seed, **_: few(path, seed=seed)
    )
    first, repeated, other = (
        demo_data(tmp_path / n, seed=s) for n, s in (("a", 0), ("b", 0), ("c", 1))
    )
    assert first["esimas"].read_bytes() == demo["esimas"].read_bytes()
    for name, path in first.items():
        assert repeated[name].read_bytes() == path.read_bytes()
        assert other[name].read_bytes() != path.read_bytes()


def test_header_has_no_date(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    contents = set()
    for date in ("Thu Jan  1 00:00:00 1970", "Fri Dec 31 23:59:59 1999"):
        monkeypatch.setattr(time, "asctime", lambda *_, date=date: date)
        contents.add(traffic_recording(tmp_path / "a.mat", seed=0).read_bytes())
    assert len(contents) == 1


def test_platoons_follow_the_law(tmp_path: Path) -> None:
    truth = SlowZone(drivers=0.0, noise=0.0)
    table = pd.read_csv(platoon_table(tmp_path / "p.csv", seed=2, truth=truth, platoons=3, dt=0.02))
    assert list(table.columns) == ["sequence", "time", "agent", "x"]
    inside = 0
    for _, part in table.groupby("sequence"):
        x = part.pivot(index="time", columns="agent", values="x")
        place, step = np.array(x), np.diff(x.index).mean()
        speed = (place[2:, :-1] - place[:-2, :-1]) / (2 * step)
        here, gap = place[1:-1, :-1], np.diff(place, axis=1)[1:-1]
        zone = (here >= truth.a) & (here <= truth.b)
        expected = np.where(zone, truth.alpha, 1.0) * truth.v0 * (1 - truth.L / gap)
        # speeds change discontinuously at the ends of the zone
        clear = (np.abs(here - truth.a) > 1) & (np.abs(here - truth.b) > 1)
        # positions are written to the millimetre
        np.testing.assert_allclose(speed[clear], expected[clear], atol=0.06)
        inside += int((zone & clear).sum())
    assert inside > 100


@pytest.mark.thorough
def test_drivers_and_noise_of_platoons(tmp_path: Path) -> None:
    exact = SlowZone(drivers=0.0, noise=0.0)
    clean, noisy = (
        pd.read_csv(platoon_table(tmp_path / "t.csv", seed=4, truth=truth, platoons=8))
        for truth in (exact, replace(exact, noise=0.1))
    )
    error = noisy["x"] - clean["x"]
    assert error.std() == pytest.approx(0.1, abs=5 * 0.1 / math.sqrt(2 * len(error)))
    assert clean["agent"].nunique() == 8 * 5  # no agent is in two platoons
    tables = [platoon_table(tmp_path / n, seed=4, platoons=2).read_bytes() for n in ("c", "d")]
    assert tables[0] == tables[1]


def test_demo_tables_differ_only_after_the_zone(demo: dict[str, Path]) -> None:
    with_zone, without = (pd.read_csv(demo[name]) for name in ("table", "nothing_hidden"))
    keys = ["sequence", "time", "agent"]
    assert with_zone[keys].equals(without[keys])
    assert with_zone["sequence"].nunique() == 20
    difference = (with_zone["x"] - without["x"]).abs()
    # no vehicle of the platoon has reached the zone
    before = with_zone.groupby(keys[:2])["x"].transform("max") < SlowZone().a - 1
    assert before.any()
    assert (difference[before] < 1e-6).all()
    assert difference.max() > 10
