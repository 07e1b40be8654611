"""Trajectories that are written and read again: PedPy's text, Parquet, and simulated ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nnode.data.options import JuelichOptions, TableOptions
from nnode.data.readers.juelich import read_juelich
from nnode.data.readers.table import read_table
from nnode.data.sequence import Batch, Sequence
from nnode.errors import DataError
from nnode.exchange.trajectories import simulated, write_parquet, write_pedpy
from nnode.solvers.base import Trajectory


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
    with pytest.raises(DataError, match=r"a/0.*two coordinates.*leave pedpy out"):
        write_pedpy(tmp_path, [lane])


def test_a_crowd_s_table_is_read_as_it_was(tmp_path: Path) -> None:
    first = walk(group=("g", "", "g"), kind=("child", "", ""), length=np.array([0.3, 0.4, np.nan]))
    second = walk(start=30, name="run/003", group=("", "", ""), kind=("child", "", ""))
    path = write_parquet(tmp_path / "deep" / "walk.parquet", [first, second], 2)
    found = read_table(path, TableOptions(domain="crowd", path=str(path)))
    for back, s in zip(found, (first, second), strict=True):
        assert (back.name, back.recording, back.agents) == (s.name, s.recording, s.agents)
        np.testing.assert_array_equal(back.x, s.x)
        np.testing.assert_array_equal(back.destination, s.x[-1])
        assert (back.group, back.kind) == (s.group, s.kind)
    np.testing.assert_array_equal(found[0].length, first.length)


def test_traffic_s_table_is_read_as_it_was(tmp_path: Path) -> None:
    time = np.arange(5) * 0.2
    x = np.array([0.0, 30.0])[None, :, None] + 20 * time[:, None, None]
    s = Sequence(name="road/0", recording="road", time=time, x=x, length=np.array([4.0, np.nan]))
    path = write_parquet(tmp_path / "road.parquet", [s], 1)
    (back,) = read_table(path, TableOptions(domain="traffic", path=str(path)))
    np.testing.assert_array_equal(back.x, s.x)
    np.testing.assert_array_equal(back.length, s.length)


def test_nothing_is_left_of_a_table_that_failed(tmp_path: Path) -> None:
    def broken():
        yield walk()
        raise DataError("no more")

    with pytest.raises(DataError, match="no more"):
        write_parquet(tmp_path / "walk.parquet", broken(), 2)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("size", [1, 2, 5])
def test_simulated_sequences_lose_their_padding(size: int) -> None:
    def straight(batch: Batch) -> Trajectory:
        t = batch.dt * torch.arange(batch.n_samples).double()[:, None, None, None]
        return Trajectory(batch.x[0] + t * batch.v[0], batch.v[:1].expand_as(batch.x))

    given_ = [walk(3, 11), walk(1, 21, name="run/003"), walk(2, 5, name="run/004")]
    found = list(simulated(straight, given_, size=size))
    for s, back in zip(given_, found, strict=True):
        assert (back.name, back.agents) == (s.name, s.agents)
        speed = s.velocity()[0]
        np.testing.assert_allclose(back.x, s.x[0] + (s.time - s.time[0])[:, None, None] * speed)
        np.testing.assert_allclose(back.v, np.broadcast_to(speed, s.x.shape))
        np.testing.assert_array_equal(back.destination, s.x[-1])  # measured, not simulated
