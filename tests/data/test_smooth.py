"""Smoothing: exact on cubics, and the figures of docs/data.md."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from nnode.data.limits import BEARABLE
from nnode.data.options import DataOptions
from nnode.data.prepare import prepare
from nnode.data.readers.jupedsim import WalkwayOptions
from nnode.data.readers.ngsim import NgsimOptions, read_ngsim
from nnode.data.readers.openacc import OpenAccOptions
from nnode.data.readers.pairs import PairOptions
from nnode.data.readers.table import TableOptions
from nnode.data.readers.vehicles import VehicleTableOptions, read_vehicles
from nnode.data.sequence import Sequence
from nnode.data.smooth import measured_noise, smooth
from nnode.data.trajectories import Grid, Record, Trajectories, records
from nnode.errors import ConfigError
from tests.data.tables import saved

DOCS = Path(__file__).parents[2] / "docs" / "data.md"
STEP = 0.1
WINDOWS = (None, 1.0, 2.0, 4.0)


def truth(seconds: float = 600.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, speed and acceleration of a car in stop-and-go traffic.

    Waves of 60 s between 2 and 18 m/s, with corrections of 5 s by a driver on top: accelerations
    of up to 1.5 m/s².
    """
    time = np.arange(0, seconds, STEP)
    slow, quick = 2 * np.pi / 60, 2 * np.pi / 5
    speed = 10 - 8 * np.cos(slow * time) + 0.5 * np.sin(quick * time)
    return time, speed, 8 * slow * np.sin(slow * time) + 0.5 * quick * np.cos(quick * time)


def position(time: np.ndarray) -> np.ndarray:
    slow, quick = 2 * np.pi / 60, 2 * np.pi / 5
    return 10 * time - 8 / slow * np.sin(slow * time) - 0.5 / quick * np.cos(quick * time)


def errors(kind: str, n: int) -> np.ndarray:
    """Errors of 0.3 m that are new at every sample, or that last (1 s)."""
    draw = np.random.default_rng(0).standard_normal(n)
    if kind == "new":
        return 0.3 * draw
    keep, result = np.exp(-STEP), np.empty(n)
    result[0] = draw[0]
    for k in range(1, n):
        result[k] = keep * result[k - 1] + np.sqrt(1 - keep**2) * draw[k]
    return 0.3 * result


def spread(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def acceleration(s: Sequence) -> np.ndarray:
    return np.diff(s.velocity(), axis=0) / s.dt


def figures(folder: Path, kind: str, window: float | None) -> tuple[float, float, float]:
    """RMS errors (m, m/s, m/s²) of what the reader gives."""
    time, speed, force = truth()
    x = position(time)
    table = pd.DataFrame({"vehicle": 1, "time": time, "x": x + errors(kind, len(time))})
    path = saved(folder / f"{kind}-{window}.csv", table)
    (s,) = read_vehicles(path, VehicleTableOptions(min_vehicles=1, smooth=window))
    at = np.round(s.time / STEP).astype(int)[1:-1]  # the last speed of a measured one is repeated
    middle = 0.5 * (force[at[:-1]] + force[at[1:]])
    return (
        spread(s.x[1:-1, 0, 0] - x[at]),
        spread(s.velocity()[1:-1, 0, 0] - speed[at]),
        spread(acceleration(s)[1:-1, 0, 0] - middle),
    )


def test_a_cubic_stays_as_it_is() -> None:
    time = np.arange(0, 8, STEP)
    x = 3 + 8 * time + 0.5 * time**2 - 0.05 * time**3
    result, speed = smooth(time, x, 2.0)
    np.testing.assert_allclose(result, x, atol=1e-9)
    np.testing.assert_allclose(speed, 8 + time - 0.15 * time**2, atol=1e-8)
    # a hole that is interpolated, and a record shorter than the window
    some = np.delete(np.arange(len(time)), [31, 32])
    assert np.abs(smooth(time[some], x[some], 2.0)[0] - x[some]).max() < 0.01
    np.testing.assert_allclose(smooth(time[:8], x[:8], 2.0)[1], (8 + time - 0.15 * time**2)[:8])


@pytest.mark.parametrize("samples", [1, 2, 3, 4])
def test_a_partof_few_samples_stays_as_it_is(samples: int) -> None:
    time = STEP * np.arange(samples)
    result, speed = smooth(time, 5 * time, 2.0)
    np.testing.assert_array_equal(result, 5 * time)
    np.testing.assert_allclose(speed, 5.0 if samples > 1 else 0.0)


def test_a_window_that_smooths_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"smooth=0.3 s holds 3 samples .* data.smooth=0.4 at le"):
        figures(tmp_path, "new", 0.3)
    with pytest.raises(ConfigError, match=r"data.smooth=-1.0: expected a positive number"):
        figures(tmp_path, "new", -1.0)


def test_records_are_smoothed_apart_and_nobody_rolls_back(tmp_path: Path) -> None:
    time = np.arange(0, 10, STEP)
    noise = np.random.default_rng(0).normal(0, 0.3, (2, len(time)))
    parts = [pd.DataFrame({"vehicle": i, "time": time, "x": 50.0 * i + noise[i]}) for i in range(2)]
    options = VehicleTableOptions(min_vehicles=2, smooth=2.0)
    (s,) = read_vehicles(saved(tmp_path / "t.csv", *parts), options)
    assert (s.velocity() >= 0).all()
    assert np.abs(s.x[:, :, 0] - [0, 50]).max() < 1


def row(label: str) -> list[float]:
    """The figures in a row of the page's table."""
    (line,) = (line for line in DOCS.read_text().splitlines() if line.startswith(f"| {label} |"))
    return [float(number) for number in re.findall(r"\d+\.\d+", line.split("|", 2)[2])]


@pytest.mark.parametrize("window", WINDOWS)
def test_the_page_s_figures_on_a_known_truth(tmp_path: Path, window: float | None) -> None:
    result = [f for kind in ("new", "lasting") for f in figures(tmp_path, kind, window)]
    label = "as measured" if window is None else f"`data.smooth={window:g}`"
    assert row(label) == pytest.approx(result, abs=0.0006)


@pytest.mark.real
@pytest.mark.parametrize("window", WINDOWS[1:])
def test_the_page_s_figures_on_a_reconstructed_table(real_data: Path, window: float | None) -> None:
    path = real_data / "ngsim" / "i80_lanes_1_2.csv"
    raw = read_ngsim(path, NgsimOptions(window=10.0))
    result = read_ngsim(path, NgsimOptions(window=10.0, smooth=window))
    assert [s.agents for s in raw] == [s.agents for s in result]
    pairs = list(zip(raw, result, strict=True))
    figures = [
        spread(np.concatenate([(a.x - b.x).ravel() for a, b in pairs])),
        spread(np.concatenate([(a.velocity() - b.velocity()).ravel() for a, b in pairs])),
        *(
            spread(np.concatenate([acceleration(s).ravel() for s in group]))
            for group in (raw, result)
        ),
    ]
    assert row(f"NGSIM, `data.smooth={window:g}`") == pytest.approx(figures, abs=0.0006)


@pytest.mark.parametrize("rate", [5.0, 10.0])
@pytest.mark.parametrize("sigma", [0.02, 0.1, 0.3])
def test_the_noise_of_positions_is_found(rate: float, sigma: float) -> None:
    rng = np.random.default_rng(int(100 * sigma + rate))
    time = np.arange(int(50 * rate)) / rate
    # accelerations up to 1.5 m/s², corrections of 5 s among them
    paths = [
        14 * time + 0.6 * np.sin(2 * np.pi * time / 5 + p) + 30 * np.sin(0.15 * time + 2 * p)
        for p in range(20)
    ]
    x = np.stack(paths, 1)[..., None]
    x = x + sigma * rng.normal(size=x.shape)
    x[100, 3] += 40.0  # outliers do not matter
    result = measured_noise([Sequence(name="a", recording="a", time=time, x=x)])
    assert result.position == pytest.approx(sigma, rel=0.05)
    assert result.start_speed == pytest.approx(np.sqrt(2) * sigma * rate, rel=0.05)
    assert result.beyond == (result.start_speed > BEARABLE)


def record(time: np.ndarray, x: np.ndarray) -> list[Record]:
    """Records of one car at 10 Hz."""
    rows = Trajectories(
        path=Path("t"),
        name="t",
        where=str,
        agent=np.full(len(time), "a", dtype=object),
        time=time,
        x=x[:, None],
    )
    return records(rows, Grid(0.1), fill=0.5)


def test_a_hole_does_not_bias_speeds() -> None:
    time = 0.1 * np.arange(60)
    x = 10 * time + 0.5 * 1.5 * time**2
    (result,) = record(np.delete(time, range(20, 25)), np.delete(x, range(20, 25)))
    np.testing.assert_allclose(result.x[:, 0], x, atol=1e-9)
    assert result.filled.nonzero()[0].tolist() == [20, 21, 22, 23, 24]
    line = np.interp(time, time[~result.filled], x[~result.filled])
    assert (np.diff(x) - np.diff(line))[19] / 0.1 < -0.3  # m/s, the bias of a straight line
    # what is longer ends a record, and so does an empty cell
    apart = record(np.delete(time, range(20, 26)), np.delete(x, range(20, 26)))
    assert [(part.first, part.last) for part in apart] == [(0, 19), (26, 59)]
    lacking = x.copy()
    lacking[20:26] = np.nan
    assert [len(part.x) for part in record(time, lacking)] == [20, 34]


NOISE = 0.05 * np.random.default_rng(6).standard_normal((3, 120))
CARS = 8.0 * 0.1 * np.arange(120) + 25.0 * np.arange(3)[:, None] + NOISE


def rows_of() -> pd.DataFrame:
    """Three cars, one row per car and time, the last one in front."""
    time = (0.1 * np.arange(120)).round(3)
    table = pd.DataFrame({"vehicle": np.repeat(range(3), 120), "time": np.tile(time, 3)})
    return table.assign(x=CARS.ravel())


def as_vehicles(path: Path) -> DataOptions:
    return VehicleTableOptions(path=str(saved(path / "t.csv", rows_of())), dt=0.1)


def as_table(path: Path) -> DataOptions:
    table = rows_of().rename(columns={"vehicle": "agent"}).assign(sequence=1)
    return TableOptions(domain="traffic", path=str(saved(path / "t.csv", table)))


def as_pairs(path: Path) -> DataOptions:
    pair = {"time": 0.1 * np.arange(120), "x_follower": CARS[0], "x_leader": CARS[1]}
    return PairOptions(path=str(saved(path / "t.csv", pd.DataFrame(pair))))


def as_openacc(path: Path) -> DataOptions:
    """Positions follow from gaps: their noise is that of the gaps."""
    table = rows_of().assign(run=1, v=8.0, position=lambda t: 3 - t.vehicle)
    table["gap"] = 20.0 + table.x - table.time * 8.0 - 25.0 * table.vehicle
    table.rename(columns={"time": "t"}).drop(columns="x").to_csv(path / "t.csv", index=False)
    return OpenAccOptions(path=str(path / "t.csv"), max_error=None)


def as_people(path: Path) -> DataOptions:
    rows = [f"{i} {k} {CARS[i, k] / 8:.6f} {i} 0" for i in range(3) for k in range(120)]
    (path / "t.txt").write_text("# framerate: 10\n# id frame x/m y/m z/m\n" + "\n".join(rows))
    return WalkwayOptions(path=str(path / "t.txt"), t_seq=5.0)


#: One of each way of cutting records.
SOURCES = [as_vehicles, as_table, as_pairs, as_openacc, as_people]


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.__name__)
def test_every_cutting_smooths(tmp_path: Path, source: Callable[[Path], DataOptions]) -> None:
    options = source(tmp_path)
    raw = prepare(options, tmp_path / "raw")
    smooth = prepare(replace(options, smooth=1.0), tmp_path / "smooth")
    assert len(raw) == len(smooth) >= 1
    assert smooth[0].v is not None
    before, after = (np.abs(np.diff(s[0].x[:, 0, 0], 4)).mean() for s in (raw, smooth))
    assert after < 0.2 * before
