"""Smoothing: exact for cubics, and the numbers of docs/data.md."""

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


SLOW, QUICK = 2 * np.pi / 60, 2 * np.pi / 5


def truth(seconds: float = 600.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, speed and acceleration of a car in stop-and-go traffic.

    The speed oscillates with a period of 60 s between 2 m/s and 18 m/s; the driver's corrections
    add a period of 5 s. Accelerations reach 1.5 m/s².
    """
    time = np.arange(0, seconds, STEP)
    speed = 10 - 8 * np.cos(SLOW * time) + 0.5 * np.sin(QUICK * time)
    return time, speed, 8 * SLOW * np.sin(SLOW * time) + 0.5 * QUICK * np.cos(QUICK * time)


def position(time: np.ndarray) -> np.ndarray:
    return 10 * time - 8 / SLOW * np.sin(SLOW * time) - 0.5 / QUICK * np.cos(QUICK * time)


def errors(kind: str, n: int) -> np.ndarray:
    """Errors of 0.3 m, independent or with a correlation time of 1 s."""
    draws = np.random.default_rng(0).standard_normal(n)
    if kind == "lasting":
        decay = np.exp(-STEP)
        for k in range(1, n):
            draws[k] = decay * draws[k - 1] + np.sqrt(1 - decay**2) * draws[k]
    return 0.3 * draws


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def acceleration(s: Sequence) -> np.ndarray:
    return np.diff(s.velocity(), axis=0) / s.dt


def rms_errors(folder: Path, kind: str, window: float | None) -> tuple[float, float, float]:
    """RMS errors of the read positions (m), speeds (m/s) and accelerations (m/s²)."""
    time, speed, acc = truth()
    x = position(time)
    table = pd.DataFrame({"vehicle": 1, "time": time, "x": x + errors(kind, len(time))})
    path = saved(folder / f"{kind}-{window}.csv", table)
    (s,) = read_vehicles(path, VehicleTableOptions(min_vehicles=1, smooth=window))
    at = np.round(s.time / STEP).astype(int)[1:-1]  # without the last speed, which is repeated
    middle = 0.5 * (acc[at[:-1]] + acc[at[1:]])
    return (
        rms(s.x[1:-1, 0, 0] - x[at]),
        rms(s.velocity()[1:-1, 0, 0] - speed[at]),
        rms(acceleration(s)[1:-1, 0, 0] - middle),
    )


def test_cubic_is_not_changed() -> None:
    time = np.arange(0, 8, STEP)
    x, v = 3 + 8 * time + 0.5 * time**2 - 0.05 * time**3, 8 + time - 0.15 * time**2
    result, speed = smooth(time, x, 2.0)
    np.testing.assert_allclose(result, x, atol=1e-9)
    np.testing.assert_allclose(speed, v, atol=1e-8)
    # with a hole that is interpolated, and for a record shorter than the window
    kept = np.delete(np.arange(len(time)), [31, 32])
    assert np.abs(smooth(time[kept], x[kept], 2.0)[0] - x[kept]).max() < 0.01
    np.testing.assert_allclose(smooth(time[:8], x[:8], 2.0)[1], v[:8])


@pytest.mark.parametrize("samples", [1, 2, 3, 4])
def test_few_samples_are_not_changed(samples: int) -> None:
    time = STEP * np.arange(samples)
    result, speed = smooth(time, 5 * time, 2.0)
    np.testing.assert_array_equal(result, 5 * time)
    np.testing.assert_allclose(speed, 5.0 if samples > 1 else 0.0)


@pytest.mark.parametrize(
    ("window", "message"),
    [
        (0.3, r"smooth=0.3 s holds 3 samples .* data.smooth=0.4 at le"),
        (-1.0, "data.smooth=-1.0: expected a positive number"),
    ],
)
def test_invalid_windows_are_refused(tmp_path: Path, window: float, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        rms_errors(tmp_path, "new", window)


def test_records_are_smoothed_separately_without_negative_speeds(tmp_path: Path) -> None:
    time = np.arange(0, 10, STEP)
    noise = np.random.default_rng(0).normal(0, 0.3, (2, len(time)))
    parts = [pd.DataFrame({"vehicle": i, "time": time, "x": 50.0 * i + noise[i]}) for i in range(2)]
    options = VehicleTableOptions(min_vehicles=2, smooth=2.0)
    (s,) = read_vehicles(saved(tmp_path / "t.csv", *parts), options)
    assert (s.velocity() >= 0).all()
    assert np.abs(s.x[:, :, 0] - [0, 50]).max() < 1


def documented(label: str) -> list[float]:
    """The numbers in a row of the documented table."""
    (line,) = (line for line in DOCS.read_text().splitlines() if line.startswith(f"| {label} |"))
    return [float(number) for number in re.findall(r"\d+\.\d+", line.split("|", 2)[2])]


@pytest.mark.parametrize("window", WINDOWS)
def test_documented_errors_for_a_known_path(tmp_path: Path, window: float | None) -> None:
    expected = [f for kind in ("new", "lasting") for f in rms_errors(tmp_path, kind, window)]
    label = "as measured" if window is None else f"`data.smooth={window:g}`"
    assert documented(label) == pytest.approx(expected, abs=0.0006)


@pytest.mark.real
@pytest.mark.parametrize("window", WINDOWS[1:])
def test_documented_errors_for_a_reconstructed_table(real_data: Path, window: float | None) -> None:
    path = real_data / "ngsim" / "i80_lanes_1_2.csv"
    raw = read_ngsim(path, NgsimOptions(window=10.0))
    result = read_ngsim(path, NgsimOptions(window=10.0, smooth=window))
    assert [s.agents for s in raw] == [s.agents for s in result]
    pairs = list(zip(raw, result, strict=True))
    measured = [
        rms(np.concatenate([(a.x - b.x).ravel() for a, b in pairs])),
        rms(np.concatenate([(a.velocity() - b.velocity()).ravel() for a, b in pairs])),
        *(rms(np.concatenate([acceleration(s).ravel() for s in group])) for group in (raw, result)),
    ]
    assert documented(f"NGSIM, `data.smooth={window:g}`") == pytest.approx(measured, abs=0.0006)


@pytest.mark.parametrize("rate", [5.0, 10.0])
@pytest.mark.parametrize("sigma", [0.02, 0.1, 0.3])
def test_noise_of_positions(rate: float, sigma: float) -> None:
    rng = np.random.default_rng(int(100 * sigma + rate))
    time = np.arange(int(50 * rate)) / rate
    # accelerations up to 1.5 m/s²; corrections have a period of 5 s
    paths = [
        14 * time + 0.6 * np.sin(2 * np.pi * time / 5 + p) + 30 * np.sin(0.15 * time + 2 * p)
        for p in range(20)
    ]
    x = np.stack(paths, 1)[..., None]
    x = x + sigma * rng.normal(size=x.shape)
    x[100, 3] += 40.0  # an outlier has no effect
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


def test_hole_does_not_bias_speeds() -> None:
    time = 0.1 * np.arange(60)
    x = 10 * time + 0.5 * 1.5 * time**2
    (result,) = record(np.delete(time, range(20, 25)), np.delete(x, range(20, 25)))
    np.testing.assert_allclose(result.x[:, 0], x, atol=1e-9)
    assert result.filled.nonzero()[0].tolist() == [20, 21, 22, 23, 24]
    line = np.interp(time, time[~result.filled], x[~result.filled])
    assert (np.diff(x) - np.diff(line))[19] / 0.1 < -0.3  # m/s, the bias of linear interpolation
    # a longer hole ends a record, and so do empty cells
    parts = record(np.delete(time, range(20, 26)), np.delete(x, range(20, 26)))
    assert [(part.first, part.last) for part in parts] == [(0, 19), (26, 59)]
    x[20:26] = np.nan
    assert [len(part.x) for part in record(time, x)] == [20, 34]


NOISE = 0.05 * np.random.default_rng(6).standard_normal((3, 120))
CARS = 8.0 * 0.1 * np.arange(120) + 25.0 * np.arange(3)[:, None] + NOISE


def vehicle_rows() -> pd.DataFrame:
    """Three cars, one row per car and time; the last car is the leader."""
    time = (0.1 * np.arange(120)).round(3)
    table = pd.DataFrame({"vehicle": np.repeat(range(3), 120), "time": np.tile(time, 3)})
    return table.assign(x=CARS.ravel())


def as_vehicles(path: Path) -> DataOptions:
    return VehicleTableOptions(path=str(saved(path / "t.csv", vehicle_rows())), dt=0.1)


def as_table(path: Path) -> DataOptions:
    table = vehicle_rows().rename(columns={"vehicle": "agent"}).assign(sequence=1)
    return TableOptions(domain="traffic", path=str(saved(path / "t.csv", table)))


def as_pairs(path: Path) -> DataOptions:
    pair = {"time": 0.1 * np.arange(120), "x_follower": CARS[0], "x_leader": CARS[1]}
    return PairOptions(path=str(saved(path / "t.csv", pd.DataFrame(pair))))


def as_openacc(path: Path) -> DataOptions:
    """Positions follow from gaps and have their noise."""
    table = vehicle_rows().assign(run=1, v=8.0, position=lambda t: 3 - t.vehicle)
    table["gap"] = 20.0 + table.x - table.time * 8.0 - 25.0 * table.vehicle
    table.rename(columns={"time": "t"}).drop(columns="x").to_csv(path / "t.csv", index=False)
    return OpenAccOptions(path=str(path / "t.csv"), max_error=None)


def as_people(path: Path) -> DataOptions:
    rows = [f"{i} {k} {CARS[i, k] / 8:.6f} {i} 0" for i in range(3) for k in range(120)]
    (path / "t.txt").write_text("# framerate: 10\n# id frame x/m y/m z/m\n" + "\n".join(rows))
    return WalkwayOptions(path=str(path / "t.txt"), t_seq=5.0)


#: One source for each way to divide records.
SOURCES = [as_vehicles, as_table, as_pairs, as_openacc, as_people]


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.__name__)
def test_every_reader_smooths(tmp_path: Path, source: Callable[[Path], DataOptions]) -> None:
    options = source(tmp_path)
    raw = prepare(options, tmp_path / "raw")
    smooth = prepare(replace(options, smooth=1.0), tmp_path / "smooth")
    assert len(raw) == len(smooth) >= 1
    assert smooth[0].v is not None
    before, after = (np.abs(np.diff(s[0].x[:, 0, 0], 4)).mean() for s in (raw, smooth))
    assert after < 0.2 * before
