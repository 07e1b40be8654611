"""Writing trajectories in every format and reading them; simulated trajectories."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

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
from tests.builders import lane, people

ENDINGS = pytest.mark.parametrize("ending", ["parquet", "csv"])


def walk(
    n: int = 3, k: int = 11, dt: float = 0.1, start: int = 20, name: str = "run/002", **more: Any
) -> Sequence:
    """People who walk on separate circles."""
    angle = dt * (start + np.arange(k))[:, None] + np.arange(n)
    x = np.stack([np.cos(angle) + 3 * np.arange(n), np.sin(angle)], -1)
    more.setdefault("agents", tuple(str(7 * i + 3) for i in range(n)))
    return people(x, dt, start=dt * start, name=name, **more)


@given(
    n=st.integers(1, 4),
    k=st.integers(2, 30),
    rate=st.sampled_from([1.0, 3.0, 8.0, 12.5, 16.0, 25.0, 29.97, 30.0]),
    start=st.integers(0, 10_000),
)
@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_text_round_trip(tmp_path: Path, n: int, k: int, rate: float, start: int) -> None:
    s = walk(n, k, 1 / rate, start)
    (path,) = write_pedpy(tmp_path, [s])
    assert path.name == "run_002.txt"
    (read,) = read_juelich(path, JuelichOptions(t_seq=(k - 1) / rate))
    assert read.agents == s.agents
    np.testing.assert_allclose(read.x, s.x, atol=5.1e-7)
    np.testing.assert_allclose(read.time, s.time, rtol=1e-9)


@pytest.mark.parametrize(
    "agents", [(), ("1", "2", "9" * 40), ("ann", "x/cm", "framerate 7"), ("1", "01", "2")]
)
def test_names_that_are_not_numbers_are_numbered(tmp_path: Path, agents: tuple[str, ...]) -> None:
    s = walk(agents=agents)
    (path,) = write_pedpy(tmp_path, [s])
    (read,) = read_juelich(path, JuelichOptions())
    assert read.agents == ("1", "2", "3")
    assert read.dt == pytest.approx(0.1)
    np.testing.assert_allclose(read.x, s.x, atol=5.1e-7)
    for i, name in enumerate(agents, start=1):
        assert f"# {i} is {name.replace('/', ' ')}\n" in path.read_text()


def test_file_names_are_unique(tmp_path: Path) -> None:
    paths = write_pedpy(tmp_path, [walk(name="run/2"), walk(name="run_2"), walk(name="run:2")])
    assert [p.name for p in paths] == ["run_2.txt", "run_2_.txt", "run_2__.txt"]


def test_text_needs_two_coordinates(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"a/0.*two coordinates.*take another format"):
        write_pedpy(tmp_path, [lane(np.zeros((3, 2)), name="a/0")])


@pytest.mark.parametrize(
    ("name", "domain", "message"),
    [
        ("pedpy", "traffic", r"format=pedpy is not for traffic; .* one of parquet, csv, fcd"),
        ("fcd", "crowd", r"format=fcd is not for crowd; .* one of parquet, csv, pedpy"),
        ("xlsx", "crowd", r"format=xlsx is unknown; for crowd take one of parquet, csv, pedpy"),
    ],
)
def test_unsuitable_format_is_refused(name: str, domain: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        check_format("format", name, domain)


def drive(name: str, n: int, k: int, start: int = 0, dt: float = 0.1, **more: Any) -> Sequence:
    """Vehicles 20 m apart at about 15 m/s, each slightly faster than its follower."""
    rng = np.random.default_rng(n)
    v = 15 + np.cumsum(rng.uniform(0.1, 0.5, (k, n)), axis=1)
    x = 20.0 * np.arange(n) + dt * np.cumsum(v, axis=0)
    return lane(x, dt, v=v, start=dt * start, name=name, **more)


def test_floating_car_data_round_trip(tmp_path: Path) -> None:
    """Sequences overlap in time, and identifiers are repeated or absent."""
    sequences = [
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
    path = write_fcd(tmp_path / "samples.xml.gz", sequences)
    options = SumoOptions(path=str(path), dt=0.1, min_vehicles=2, window=None)
    lanes = ["road_0~1", "road_0~2", "road_1~1", "road_1~1_"]
    result = {s.recording: s for s in read_sumo(path, options)}
    assert sorted(result) == [f"samples_{name}" for name in lanes]
    for name, s in zip(lanes, sequences, strict=True):
        read = result[f"samples_{name}"]
        assert read.agents == tuple(f"{name}.{a}" for a in s.agents or map(str, range(s.n_agents)))
        np.testing.assert_allclose(read.time, s.time, rtol=0, atol=1e-9)
        np.testing.assert_allclose(read.x, s.x, rtol=0, atol=1e-9)
        np.testing.assert_allclose(read.v, s.v, rtol=0, atol=1e-9)
    first, second = (result[f"samples_{name}"] for name in lanes[:2])
    assert (first.kind, second.kind) == (("car", "truck", "car"), ("", "", ""))
    np.testing.assert_array_equal(first.length, sequences[0].length)
    assert second.length is None
    second_path = write_fcd(tmp_path / "second.xml.gz", sequences)
    assert second_path.read_bytes() == path.read_bytes()


def test_floating_car_data_without_speeds(tmp_path: Path) -> None:
    s = replace(drive("road/0", 2, 12), v=None)
    path = write_fcd(tmp_path / "fcd.xml.gz", [s])
    options = SumoOptions(path=str(path), dt=0.1, min_vehicles=2, window=None)
    (read,) = read_sumo(path, options)
    assert read.v is None
    np.testing.assert_allclose(read.x, s.x, rtol=0, atol=1e-9)


@ENDINGS
def test_table_of_people_round_trip(tmp_path: Path, ending: str) -> None:
    first = walk(group=("g", "", "g"), kind=("child", "", ""), length=np.array([0.3, 0.4, np.nan]))
    # texts that spreadsheets would read as formulas; people are sorted by name
    second = walk(
        start=30,
        name="run/+a",
        agents=("'@x", "-7", "=1+1"),
        group=("@", "", ""),
        kind=("-k", "", "=k"),
    )
    path = write_table(tmp_path / "deep" / f"walk.{ending}", [first, second], 2)
    if ending == "csv":
        cells = pd.read_csv(path, dtype=str)
        assert {"'=1+1", "''@x", "-7"} < set(cells["agent"])
        assert not cells["sequence"].str.match(r"[=+\-@]").any()
    result = read_table(path, TableOptions(domain="crowd", path=str(path)))
    for read, s in zip(result, (first, second), strict=True):
        assert (read.name, read.recording, read.agents) == (s.name, s.recording, s.agents)
        np.testing.assert_array_equal(read.x, s.x)
        np.testing.assert_array_equal(read.destination, s.x[-1])
        assert (read.group, read.kind) == (s.group, s.kind)
    np.testing.assert_array_equal(result[0].length, first.length)


@ENDINGS
def test_table_of_vehicles_round_trip(tmp_path: Path, ending: str) -> None:
    x = np.array([0.0, 30.0]) + 4.0 * np.arange(5)[:, None]
    s = lane(x, name="road/0", length=np.array([4.0, np.nan]))
    path = write_table(tmp_path / f"road.{ending}", [s], 1)
    (read,) = read_table(path, TableOptions(domain="traffic", path=str(path)))
    np.testing.assert_array_equal(read.x, s.x)
    np.testing.assert_array_equal(read.length, s.length)


@ENDINGS
def test_failed_writing_leaves_no_file(tmp_path: Path, ending: str) -> None:
    def failing():
        yield walk()
        raise DataError("no more")

    with pytest.raises(DataError, match="no more"):
        write_table(tmp_path / f"walk.{ending}", failing(), 2)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("size", [1, 2, 5])
def test_simulated_sequences_have_no_padding(size: int) -> None:
    def straight(batch: Batch) -> Trajectory:
        t = batch.dt * torch.arange(batch.n_samples).double()[:, None, None, None]
        return Trajectory(batch.x[0] + t * batch.v[0], batch.v[:1].expand_as(batch.x))

    sequences = [walk(3, 11), walk(1, 21, name="run/003"), walk(2, 5, name="run/004")]
    result = list(simulated(straight, sequences, size=size))
    for s, read in zip(sequences, result, strict=True):
        assert (read.name, read.agents) == (s.name, s.agents)
        speed = s.velocity()[0]
        np.testing.assert_allclose(read.x, s.x[0] + (s.time - s.time[0])[:, None, None] * speed)
        np.testing.assert_allclose(read.v, np.broadcast_to(speed, s.x.shape))
        np.testing.assert_array_equal(read.destination, s.x[-1])  # measured, not simulated
