"""Artificial recordings: the laws they claim, the formats they copy, the same bytes again."""

from __future__ import annotations

import math
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


def test_the_last_gap_follows_its_solution(tmp_path: Path) -> None:
    # behind a leader at v0: g' = v0 L / g, so that g² = g0² + 2 v0 L t
    for x, t in platoons(traffic_recording(tmp_path / "a.mat", seed=0, v0=22.0, L=7.0)):
        gap = x[-1] - x[-2]
        np.testing.assert_allclose(gap**2, gap[0] ** 2 + 2 * 22.0 * 7.0 * (t - t[0, 0])[0])
        np.testing.assert_allclose(x[-1], x[-1, 0] + 22.0 * (t - t[0, 0])[0])


def test_every_car_drives_at_the_speed_of_its_gap(tmp_path: Path) -> None:
    for x, _ in platoons(traffic_recording(tmp_path / "a.mat", seed=1, v0=20.0, L=5.0)):
        speed = 20.0 * (1 - 5.0 / np.diff(x, axis=0))
        # Simpson's rule over two intervals of 0.2 s
        driven = 0.2 / 3 * (speed[:, :-2] + 4 * speed[:, 1:-1] + speed[:, 2:])
        np.testing.assert_allclose(x[:-1, 2:] - x[:-1, :-2], driven, atol=1e-3)


def test_platoons_have_the_shape_of_the_published_ones(tmp_path: Path) -> None:
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


def test_noise_is_as_strong_as_asked_for(tmp_path: Path) -> None:
    clean = platoons(traffic_recording(tmp_path / "a.mat", seed=5))
    noisy = platoons(traffic_recording(tmp_path / "b.mat", seed=5, noise=0.5))
    error = noisy[0][0] - clean[0][0]
    # 5 standard deviations of the sample's own standard deviation
    assert error.std() == pytest.approx(0.5, abs=5 * 0.5 / math.sqrt(2 * error.size))


# the paper's table of six settings: x_blue, x_red, v_blue, v_red, force on blue
SETTINGS = [
    ((0, 0.22), (0, -0.22), (0, -1), (0, 1), (0, 2.1118)),
    ((0, 0.22), (0, -0.22), (0, 1), (0, 1), (0, 2.1118)),
    ((0.01, 0.22), (-0.01, -0.22), (0, -1), (0, 1), (0.0417, 2.0961)),
    ((0.01, 0.22), (-0.01, -0.22), (0, 1), (0, 1), (0.0952, 2.0936)),
    ((0.22, 0), (-0.22, 0), (0, -1), (0, 1), (2.1118, 1.1867)),
    ((0.22, 0), (-0.22, 0), (0, 1), (0, 1), (2.1118, 0)),
]


@pytest.mark.parametrize(("x_blue", "x_red", "v_blue", "v_red", "force"), SETTINGS)
def test_the_pair_force_is_that_of_the_paper(
    x_blue: Any, x_red: Any, v_blue: Any, v_red: Any, force: Any
) -> None:
    forces = Forces(A=0.0044, k=34.9539, kappa=9.8894)
    offset, slip = np.subtract(x_blue, x_red), np.subtract(v_red, v_blue)
    on_blue = social_force(offset.astype(float), slip.astype(float), 0.5, forces)
    on_red = social_force(-offset.astype(float), -slip.astype(float), 0.5, forces)
    np.testing.assert_allclose(on_blue, force, atol=1e-4)
    np.testing.assert_allclose(on_red, np.negative(force), atol=1e-4)


def plain_acceleration(
    x: np.ndarray, v: np.ndarray, goal: np.ndarray, wall: np.ndarray, p: Forces
) -> np.ndarray:
    """The paper's equations written out person by person, wall point by wall point."""
    result = np.zeros_like(x)
    for i in range(len(x)):
        way = goal[i] - x[i]
        desired = way / math.hypot(*way) * math.hypot(*v[i])
        result[i] = (desired - v[i]) / p.tau
        pairs = [(x[j], v[j] - v[i], 2 * p.r, len(x)) for j in range(len(x)) if j != i]
        for other, slip, reach, count in pairs + [(w, v[i], p.r, len(wall)) for w in wall]:
            d = math.dist(x[i], other)
            n = (x[i] - other) / d
            t = np.array([-n[1], n[0]])
            h = max(reach - d, 0.0)
            force = (p.A * math.exp((reach - d) / p.B) + p.k * h) * n + p.kappa * h * (slip @ t) * t
            result[i] += force / (p.mass * count)
    return result


@pytest.mark.thorough
def test_people_are_accelerated_as_the_paper_says(tmp_path: Path) -> None:
    rate, width = 200.0, 1.2
    p = Forces(A=3.0, B=0.2)  # forces that change little between two frames
    path = crowd_recording(
        tmp_path / "c.txt",
        seed=3,
        forces=p,
        people=2,
        duration=7.0,
        length=6.0,
        width=width,
        frame_rate=rate,
        mixing=1.0,
        noise=0.0,
    )
    table = np.loadtxt(path)
    first, two = (table[table[:, 0] == i] for i in (1, 2))
    shared = np.intersect1d(first[:, 1], two[:, 1])
    x = np.stack([s[np.isin(s[:, 1], shared)][:, 2:4] / 100 for s in (first, two)], axis=1)
    lane = np.stack([first[0, 3], two[0, 3]]) / 100  # straight ahead from where each came in
    heading = np.sign(x[-1, :, 0] - x[0, :, 0])
    goal = np.column_stack([heading * (3.0 + 1.0 + 5.0), lane])
    along = np.linspace(-4.0, 4.0, 33)
    wall = np.array([(a, b) for b in (0.0, width) for a in along])
    step = 4  # positions have a resolution of 10 µm
    h = step / rate
    k = np.argmin(np.linalg.norm(x[:, 0] - x[:, 1], axis=1))
    assert math.dist(*x[k]) < 0.6
    strongest = 0.0
    for i in range(k - 30, k + 30, 6):
        v = (x[i + step] - x[i - step]) / (2 * h)
        a = (x[i + step] - 2 * x[i] + x[i - step]) / h**2
        expected = plain_acceleration(x[i], v, goal, wall, p)
        np.testing.assert_allclose(a, expected, atol=0.08)
        strongest = max(strongest, float(np.abs(expected).max()))
    assert strongest > 5.0


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return demo_data(tmp_path_factory.mktemp("demo"))


@pytest.mark.thorough
def test_the_demo_is_laid_out_like_the_real_data(demo: dict[str, Path]) -> None:
    assert demo["esimas"].parts[-2:] == ("esimas", "sequence_datademo.mat")
    assert demo["juelich"].parts[-2:] == ("juelich", "demo_corridor.txt")
    header = demo["juelich"].read_text().splitlines()[:3]
    assert all(line.startswith("#") for line in header)
    assert "# framerate: 25 fps" in header


def test_people_cross_the_corridor_in_both_directions(demo: dict[str, Path]) -> None:
    table = np.loadtxt(demo["juelich"])
    x, y = table[:, 2] / 100, table[:, 3] / 100
    assert np.abs(x).max() <= 5.01
    assert y.min() > 0
    assert y.max() < 4
    crossed = []
    for person in np.unique(table[:, 0]):
        frames = table[table[:, 0] == person, 1]
        assert (np.diff(frames) == 1).all()
        mine = x[table[:, 0] == person]
        crossed.append(mine[-1] - mine[0])
    assert len(crossed) == 45
    assert sum(c > 9 for c in crossed) >= 15
    assert sum(c < -9 for c in crossed) >= 15
    present = np.bincount(table[:, 1].astype(int))
    assert present.max() >= 10
    assert 25 <= (table[:, 1].max() - table[:, 1].min()) / 25 <= 36


@pytest.mark.thorough
def test_the_same_seed_gives_the_same_bytes(
    tmp_path: Path, demo: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    # fewer people for a shorter time: what is random about them is the same
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


def test_a_header_holds_no_date(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import time

    monkeypatch.setattr(time, "asctime", lambda *_: "Thu Jan  1 00:00:00 1970")
    first = traffic_recording(tmp_path / "a.mat", seed=0).read_bytes()
    monkeypatch.setattr(time, "asctime", lambda *_: "Fri Dec 31 23:59:59 1999")
    assert traffic_recording(tmp_path / "b.mat", seed=0).read_bytes() == first


def test_platoons_follow_the_law_of_the_table(tmp_path: Path) -> None:
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
        # not within a step of the zone's ends, where speeds jump
        clear = (np.abs(here - truth.a) > 1) & (np.abs(here - truth.b) > 1)
        # positions are written to the millimetre
        np.testing.assert_allclose(speed[clear], expected[clear], atol=0.06)
        inside += int((zone & clear).sum())
    assert inside > 100


@pytest.mark.thorough
def test_drivers_and_noise_of_platoons_are_as_asked_for(tmp_path: Path) -> None:
    still = SlowZone(drivers=0.0, noise=0.0)
    clean, noisy = (
        pd.read_csv(platoon_table(tmp_path / f"{n}.csv", seed=4, truth=truth, platoons=8))
        for n, truth in (("a", still), ("b", replace(still, noise=0.1)))
    )
    error = noisy["x"] - clean["x"]
    assert error.std() == pytest.approx(0.1, abs=5 * 0.1 / math.sqrt(2 * len(error)))
    assert clean["agent"].nunique() == 8 * 5  # nobody is in two platoons
    same = [platoon_table(tmp_path / n, seed=4, platoons=2).read_bytes() for n in ("c", "d")]
    assert same[0] == same[1]


def test_tables_of_the_demo_differ_in_the_zone_alone(demo: dict[str, Path]) -> None:
    hidden, nothing = (pd.read_csv(demo[name]) for name in ("table", "nothing_hidden"))
    assert hidden[["sequence", "time", "agent"]].equals(nothing[["sequence", "time", "agent"]])
    assert hidden["sequence"].nunique() == 20
    away = (hidden["x"] - nothing["x"]).abs()
    # nobody of the platoon has reached the zone yet
    before = hidden.groupby(["sequence", "time"])["x"].transform("max") < SlowZone().a - 1
    assert before.any()
    assert (away[before] < 1e-6).all()
    assert away.max() > 10
