"""Trajectories that are written and read again, in every format, and simulated ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nnode.data.readers.juelich import JuelichOptions, read_juelich
from nnode.data.readers.sumo import SumoOptions, read_sumo
from nnode.data.readers.table import TableOptions, read_table
from nnode.data.sequence import Batch, Sequence
from nnode.errors import ConfigError, DataError
from nnode.exchange.trajectories import (
    check_format,
    simulated,
    write_fcd,
    write_pedpy,
    write_table,
)
from nnode.simulation.base import Trajectory


def walk(
    n: int = 3, k: int = 11, dt: float = 0.1, start: int = 20, name: str = "run/002", **more: object
) -> Sequence:
    """People on circles of their own."""
    time = dt * (start + np.arange(k))
    turn = time[:, None] + np.arange(n)
    x = np.stack([np.cos(turn) + 3 * np.arange(n), np.sin(turn)], -1)
    more = {"agents": tuple(str(7 * i + 3) for i in range(n)), **more}
    return Sequence(name=name, recording=name.split("/")[0], time=time, x=x, **more)  # type: ignore[arg-type]


@given(
    n=st.integers(1, 4),
    k=st.integers(2, 30),
    rate=st.sampled_from([1.0, 3.0, 8.0, 12.5, 16.0, 25.0, 29.97, 30.0]),
    start=st.integers(0, 10_000),
)
@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_text_is_read_as_it_was(tmp_path: Path, n: int, k: int, rate: float, start: int) -> None:
    s = walk(n, k, 1 / rate, start)
    (path,) = write_pedpy(tmp_path, [s])
    assert path.name == "run_002.txt"
    (back,) = read_juelich(path, JuelichOptions(t_seq=(k - 1) / rate))
    assert back.agents == s.agents
    np.testing.assert_allclose(back.x, s.x, atol=5.1e-7)
    np.testing.assert_allclose(back.time, s.time, rtol=1e-9)


@pytest.mark.parametrize(
    "agents", [(), ("1", "2", "9" * 40), ("ann", "x/cm", "framerate 7"), ("1", "01", "2")]
)
def test_names_that_are_no_numbers_are_counted(tmp_path: Path, agents: tuple[str, ...]) -> None:
    s = walk(agents=agents)
    (path,) = write_pedpy(tmp_path, [s])
    (back,) = read_juelich(path, JuelichOptions())
    assert back.agents == ("1", "2", "3")
    assert back.dt == pytest.approx(0.1)
    np.testing.assert_allclose(back.x, s.x, atol=5.1e-7)
    for i, name in enumerate(agents, start=1):
        assert f"# {i} is {name.replace('/', ' ')}\n" in path.read_text()


def test_no_file_is_written_twice(tmp_path: Path) -> None:
    paths = write_pedpy(tmp_path, [walk(name="run/2"), walk(name="run_2"), walk(name="run:2")])
    assert [p.name for p in paths] == ["run_2.txt", "run_2_.txt", "run_2__.txt"]


def test_text_needs_two_coordinates(tmp_path: Path) -> None:
    lane = Sequence(name="a/0", recording="a", time=np.arange(3.0), x=np.zeros((3, 2, 1)))
    with pytest.raises(DataError, match=r"a/0.*two coordinates.*take another format"):
        write_pedpy(tmp_path, [lane])


@pytest.mark.parametrize(
    ("name", "domain", "told"),
    [
        ("pedpy", "traffic", r"format=pedpy is not for traffic; .* one of parquet, csv, fcd"),
        ("fcd", "crowd", r"format=fcd is not for crowd; .* one of parquet, csv, pedpy"),
        ("xlsx", "crowd", r"format=xlsx is unknown; for crowd take one of parquet, csv, pedpy"),
    ],
)
def test_a_format_that_does_not_fit(name: str, domain: str, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        check_format("format", name, domain)


def drive(name: str, n: int, k: int, start: int = 0, dt: float = 0.1, **more: object) -> Sequence:
    """Vehicles 20 m apart at 15 m/s, each a little faster than the one behind."""
    rng = np.random.default_rng(n)
    v = 15 + np.cumsum(rng.uniform(0.1, 0.5, (k, n)), axis=1)
    x = 20.0 * np.arange(n) + dt * np.cumsum(v, axis=0)
    return Sequence(
        name=name,
        recording=name.split("/")[0],
        time=dt * (start + np.arange(k)),
        x=x[:, :, None],
        v=v[:, :, None],
        **more,  # type: ignore[arg-type]
    )


def test_vehicles_are_read_as_they_were(tmp_path: Path) -> None:
    """All in one file, at the same times, some with the same identifiers and some with none."""
    given_ = [
        drive(
            "road/0~1",
            3,
            40,
            agents=("a", 'b"<', "c"),
            kind=("car", "truck", "car"),
            length=np.array([4.0, np.nan, 12.5]),
        ),
        drive("road/0~2", 3, 40, agents=("a", 'b"<', "c")),
        drive("road/1~1", 2, 25, start=20),
        drive("road:1~1", 4, 10, start=33),
    ]
    path = write_fcd(tmp_path / "samples.xml.gz", given_)
    options = SumoOptions(path=str(path), dt=0.1, min_vehicles=2, window=None)
    lanes = ["road_0~1", "road_0~2", "road_1~1", "road_1~1_"]
    result = {s.recording: s for s in read_sumo(path, options)}
    assert sorted(result) == [f"samples_{lane}" for lane in lanes]
    for lane, s in zip(lanes, given_, strict=True):
        back = result[f"samples_{lane}"]
        assert back.agents == tuple(f"{lane}.{a}" for a in s.agents or map(str, range(s.n_agents)))
        np.testing.assert_allclose(back.time, s.time, rtol=0, atol=1e-9)
        np.testing.assert_allclose(back.x, s.x, rtol=0, atol=1e-9)
        np.testing.assert_allclose(back.v, s.v, rtol=0, atol=1e-9)
    first, second = (result[f"samples_{lane}"] for lane in lanes[:2])
    assert (first.kind, second.kind) == (("car", "truck", "car"), ("", "", ""))
    np.testing.assert_array_equal(first.length, given_[0].length)
    assert second.length is None
    repeated = write_fcd(tmp_path / "again.xml.gz", given_)
    assert repeated.read_bytes() == path.read_bytes()


def test_vehicles_without_speeds(tmp_path: Path) -> None:
    s = replace(drive("road/0", 2, 12), v=None)
    path = write_fcd(tmp_path / "fcd.xml.gz", [s])
    options = SumoOptions(path=str(path), dt=0.1, min_vehicles=2, window=None)
    (back,) = read_sumo(path, options)
    assert back.v is None
    np.testing.assert_allclose(back.x, s.x, rtol=0, atol=1e-9)


@pytest.mark.parametrize("ending", ["parquet", "csv"])
def test_a_crowd_s_table_is_read_as_it_was(tmp_path: Path, ending: str) -> None:
    first = walk(group=("g", "", "g"), kind=("child", "", ""), length=np.array([0.3, 0.4, np.nan]))
    second = walk(start=30, name="run/003", group=("", "", ""), kind=("child", "", ""))
    path = write_table(tmp_path / "deep" / f"walk.{ending}", [first, second], 2)
    result = read_table(path, TableOptions(domain="crowd", path=str(path)))
    for back, s in zip(result, (first, second), strict=True):
        assert (back.name, back.recording, back.agents) == (s.name, s.recording, s.agents)
        np.testing.assert_array_equal(back.x, s.x)
        np.testing.assert_array_equal(back.destination, s.x[-1])
        assert (back.group, back.kind) == (s.group, s.kind)
    np.testing.assert_array_equal(result[0].length, first.length)


@pytest.mark.parametrize("ending", ["parquet", "csv"])
def test_traffic_s_table_is_read_as_it_was(tmp_path: Path, ending: str) -> None:
    time = np.arange(5) * 0.2
    x = np.array([0.0, 30.0])[None, :, None] + 20 * time[:, None, None]
    s = Sequence(name="road/0", recording="road", time=time, x=x, length=np.array([4.0, np.nan]))
    path = write_table(tmp_path / f"road.{ending}", [s], 1)
    (back,) = read_table(path, TableOptions(domain="traffic", path=str(path)))
    np.testing.assert_array_equal(back.x, s.x)
    np.testing.assert_array_equal(back.length, s.length)


@pytest.mark.parametrize("ending", ["parquet", "csv"])
def test_names_that_look_like_formulas_are_read_as_they_were(tmp_path: Path, ending: str) -> None:
    s = walk(
        agents=("=1+1", "'@x", "-7"), name="run/+a", kind=("-k", "", "=k"), group=("@", "", "")
    )
    path = write_table(tmp_path / f"walk.{ending}", [s], 2)
    if ending == "csv":
        cells = pd.read_csv(path, dtype=str)
        assert list(cells["agent"][:3]) == ["'=1+1", "''@x", "-7"]
        assert not cells["sequence"].str.match(r"[=+\-@]").any()
    (back,) = read_table(path, TableOptions(domain="crowd", path=str(path)))
    # people are read in the order of their names
    assert set(zip(back.agents, back.kind, back.group, strict=True)) == set(
        zip(s.agents, s.kind, s.group, strict=True)
    )
    assert back.name == s.name


@pytest.mark.parametrize("ending", ["parquet", "csv"])
def test_nothing_is_left_of_a_table_that_failed(tmp_path: Path, ending: str) -> None:
    def broken():
        yield walk()
        raise DataError("no more")

    with pytest.raises(DataError, match="no more"):
        write_table(tmp_path / f"walk.{ending}", broken(), 2)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("size", [1, 2, 5])
def test_simulated_sequences_lose_their_padding(size: int) -> None:
    def straight(batch: Batch) -> Trajectory:
        t = batch.dt * torch.arange(batch.n_samples).double()[:, None, None, None]
        return Trajectory(batch.x[0] + t * batch.v[0], batch.v[:1].expand_as(batch.x))

    given_ = [walk(3, 11), walk(1, 21, name="run/003"), walk(2, 5, name="run/004")]
    result = list(simulated(straight, given_, size=size))
    for s, back in zip(given_, result, strict=True):
        assert (back.name, back.agents) == (s.name, s.agents)
        speed = s.velocity()[0]
        np.testing.assert_allclose(back.x, s.x[0] + (s.time - s.time[0])[:, None, None] * speed)
        np.testing.assert_allclose(back.v, np.broadcast_to(speed, s.x.shape))
        np.testing.assert_array_equal(back.destination, s.x[-1])  # measured, not simulated
