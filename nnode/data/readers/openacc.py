"""Reader of OpenACC's campaigns on test tracks: platoons with and without adaptive cruise control.

Two layouts are read: the published files of the ZalaZONE campaign (five lines about the run, then
speeds, coordinates and gaps, a column per vehicle), and a table of one row per vehicle and time
(run, position, t, v, gap), as the AstaZero campaign is kept.

Source: Makridis, Mattas, Anesiadou & Ciuffo 2021, OpenACC, Transportation Research Part C 125,
103047.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from nnode.data.cut import Reading, sequence_of, whole_steps, windows
from nnode.data.options import DataOptions, chosen, one_of, positive
from nnode.data.readers.columns import Table, beginning, is_parquet
from nnode.data.readers.recordings import raw_files, tables_below
from nnode.data.sequence import Sequence
from nnode.data.smooth import smooth_columns
from nnode.data.trajectories import Grid, Record, Trajectories, driven, grouped_rows
from nnode.errors import ConfigError, DataError

log = logging.getLogger(__name__)

#: The five lines above the columns.
HEAD = ("Date", "Vehicle_order", "Number_of_vehicles", "ACC", "Distance_setting")

#: Places in a platoon; its vehicles are tens.
MOST_VEHICLES = 1000

#: Properties of a vehicle that models may be given.
KNOWN = ("make", "setting", "acc", "order")

#: Times and places of a run, with those that no row stands for, may be so many, or so many times
#: the rows.
_CELLS, _SPARSE = 10**7, 10

_FLAT = ("run", "position", "t", "v", "gap")

#: Share by which a lap may be longer than another, or than the coordinates tell.
CLOSED = 0.01

#: m within which a vehicle is back where it was: the breadth of a road.
BACK = 10.0
#: m that a vehicle must be away by before and after.
AWAY = 50.0


@dataclass
class OpenAccOptions(DataOptions):
    """Platoons on test tracks of OpenACC: speeds, and gaps from bumper to bumper.

    Each vehicle has a ``make``, ``setting`` (the distance setting of the adaptive cruise
    control, ``none`` for people), ``acc`` (``ACC`` or ``people``), ``order`` (1 leads).
    """

    name: str = "openacc"
    domain: str = "traffic"
    # a file, or a folder of files, relative to data.source where that is given; null: the published
    path: str | None = None
    # patterns of the files of a folder, of which the first that fits any is taken
    files: list[str] = field(default_factory=lambda: ["**/*.csv", "**/*.parquet"])
    kind: str | None = "make"  # make | setting | acc | order; null: not given to the models
    group: str | None = "setting"  # make | setting | acc | order; null: not given to the models
    # m, that every vehicle is taken to have, as it is not published: positions are gaps and
    # lengths; null: positions are gaps alone
    length: float | None = 5.0
    dt: float | None = None  # s, a multiple of the files' step; null: that
    # m by which a gap may change between two samples otherwise than the speeds tell, without being
    # taken for unknown: the error that one position may have; null: whatever
    max_error: float | None = 0.5
    fill: float = 0.9  # s that may be missing of a vehicle; a longer hole is not interpolated
    window: float | None = None  # s; null: maximal intervals with the same vehicles in view
    min_vehicles: int = 2  # fewest vehicles of a platoon
    min_duration: float = 5.0  # s, shortest sequence where window is null


def openacc_files(options: OpenAccOptions) -> dict[str, Path]:
    """The files of the runs: those of ``data.path``, else the published ones.

    Raises:
        ConfigError, DataError, DownloadError: see
            :func:`nnode.data.readers.recordings.tables_below` and ``raw_files``.
    """
    if options.path is not None:
        return tables_below(options, options.files)
    return raw_files(
        options,
        default="openacc",
        pattern=re.compile(r"(.+)\.csv"),
        file_name=lambda name: f"{name}.csv",
    )


def read_openacc(files: Mapping[str, Path], options: OpenAccOptions) -> Reading:
    """Read runs and cut them into sequences.

    Where a vehicle's record has a hole longer than ``fill``, or a vehicle has no columns, the
    platoon is cut in two at its place, so that nobody follows a vehicle that is not its leader.
    Gaps that are not above 0, and those that jump, count as holes (``max_error``).

    Args:
        files: see :func:`openacc_files`.
        options: what is known of vehicles, time grid and the way of cutting.

    Returns:
        Sequences named ``run/number``, with measured speeds. Vehicles are called ``make``, with
        their place in the platoon behind where there are two of a make.

    Raises:
        ConfigError: an option out of its range, or an unknown run.
        DataError: a file of another layout, cells that hold no number (names the row), unequal
            times, or no sequence at all.
    """
    _check(options)
    runs = [run for key, path in files.items() for run in _runs(key, path, options)]
    if options.path is not None:
        asked = chosen(options.recording, [run.name for run in runs])
        runs = [run for run in runs if run.name in asked]
    sequences = Reading()
    for run in runs:
        check_laps(run)
        sequences += by_spacing(run, options)
    if not sequences:
        raise DataError(
            f"{next(iter(files.values()))}: no sequence; in {len(runs)} runs there are nowhere "
            f"{options.min_vehicles} vehicles behind each other for "
            f"{options.window or options.min_duration:g} s; lower data.min_vehicles and "
            f"data.{'window' if options.window else 'min_duration'}"
        )
    return sequences


def _check(options: OpenAccOptions) -> None:
    for name in ("dt", "window", "length", "max_error", "fill", "min_duration"):
        if getattr(options, name) is not None:
            positive(name, getattr(options, name))
    for name in ("kind", "group"):
        if getattr(options, name) is not None:
            one_of(name, getattr(options, name), dict.fromkeys(KNOWN, 0.0))
    if options.min_vehicles < 1:
        raise ConfigError("data.min_vehicles must be at least 1")


def _runs(key: str, path: Path, options: OpenAccOptions) -> Iterator[Trajectories]:
    start = b"" if is_parquet(path) or not path.is_file() else beginning(path)
    lines = [*start.decode("utf-8-sig", errors="replace").splitlines(), *[""] * len(HEAD)]
    if lines[0].startswith(HEAD[0] + ","):
        name = re.sub(r"\.[^./]*$", "", key).replace("/", "_")
        table = _published(name, path, lines)
        coordinates = table.frame[["E", "N"]].to_numpy()
    else:
        table = Table(path)
        coordinates = np.full((len(table), 2), np.nan)
    names = table.choose(_FLAT, ("make", "acc", "setting"))
    run, position = table.names("run"), _positions(table)
    time = table.numbers("t")
    v, gap = (table.numbers(name, empty=True) for name in ("v", "gap"))
    words = {n: table.names(n, empty=True) for n in ("make", "acc", "setting") if n in names}
    for rows in grouped_rows(run, time=position):
        first = rows.min()
        make = [str(p + 1) for p in range(int(position[rows[-1]]))]
        for row in rows if "make" in words else ():
            make[position[row] - 1] = words["make"][row]
        acc = "acc" not in words or words["acc"][first].lower() in ("true", "1")
        setting = words["setting"][first] if "setting" in words and acc else "none"
        # nobody follows a vehicle that is not the next in front of it
        alone = ~np.isin(position[rows] - 1, position[rows])
        yield _run(
            path,
            str(run[first]),
            place=position[rows] - 1,
            make=make,
            told={"acc": "ACC" if acc else "people", "setting": setting or "none"},
            options=options,
            where=lambda i, rows=rows: table.row(int(rows[i])),
            time=time[rows],
            x=coordinates[rows],
            v=v[rows, None],
            spacing=np.where(alone, np.nan, gap[rows]),
        )


def _published(name: str, path: Path, lines: list[str]) -> Table:
    """A published file as a table with one row per vehicle and time, and with coordinates."""
    head = [[*line.strip().rstrip(",").split(","), ""] for line in lines[: len(HEAD)]]
    for number, (cells, expected) in enumerate(zip(head, HEAD, strict=True), start=1):
        if cells[0] != expected:
            raise DataError(f"{path}, line {number}: expected {expected},…, found {cells[0]!r}")
    _, order, vehicles, acc, setting = head
    make = [cell.strip() for cell in order[1:-1]]
    if vehicles[1] != str(len(make)):
        raise DataError(
            f"{path}, line 3: {vehicles[1] or 'no number of'} vehicles, but line 2 has the order "
            f"of {len(make)}: correct either"
        )
    table = Table(path, skiprows=len(HEAD))
    table.choose(("Time",))
    parts = []
    for place in range(1, len(make) + 1):
        # the first vehicle has nobody in front, and some have no coordinates
        columns = {"v": f"Speed{place}", "gap": f"IVS{place - 1}"}
        columns |= {axis: f"{axis}{place}" for axis in ("E", "N")}
        values: dict[str, Any] = {
            key: table.numbers(column, empty=True) if column in table.frame else np.nan
            for key, column in columns.items()
        }
        values |= {"t": table.numbers("Time"), "position": place, "make": make[place - 1]}
        parts.append(pd.DataFrame(values, index=table.frame.index))
    table.frame = pd.concat(parts).assign(run=name, acc=acc[1], setting=setting[1])
    return table


def _run(
    path: Path,
    name: str,
    place: np.ndarray,
    make: list[str],
    told: dict[str, str],
    options: OpenAccOptions,
    **columns: Any,
) -> Trajectories:
    """A run's rows, vehicle by vehicle.

    Args:
        place: ``(R,)`` in the platoon, 0 leads.
        make: of every place.
        told: of followers; nothing of the vehicle in front.
        columns: further ones.
    """
    names = [m if make.count(m) == 1 else f"{m}_{i + 1}" for i, m in enumerate(make)]
    words = {key: ["", *[value] * (len(make) - 1)] for key, value in told.items()}
    words |= {"make": make, "order": [str(i + 1) for i in range(len(make))]}

    def column(what: str | None) -> np.ndarray | None:
        values = words[what] if what is not None else []
        return np.array(values, dtype=object)[place] if any(values) else None

    return Trajectories(
        path=path,
        name=name,
        agent=np.array(names, dtype=object)[place],
        length=None if options.length is None else np.full(len(place), options.length),
        kind=column(options.kind),
        group=column(options.group),
        **columns,
    )


def _positions(table: Table) -> np.ndarray:
    """Places in the platoon, counted from 1."""
    positions = table.numbers("position")
    table.refuse(
        ~((positions >= 1) & (positions <= MOST_VEHICLES) & (positions % 1 == 0)),
        lambda i: (
            f"position is {positions[i]:g}; expected the place in the platoon, a whole "
            f"number from 1 to {MOST_VEHICLES}"
        ),
    )
    return positions.astype(int)


def by_spacing(rows: Trajectories, options: OpenAccOptions) -> list[Sequence]:
    """Cut a platoon whose vehicles are known by their speeds and spacings.

    The foremost vehicle of a sequence is where its integrated speed brings it, those behind it are
    the spacings and lengths further back. Where the speed or the spacing of a vehicle has a hole
    longer than ``fill``, the platoon is cut in two at its place.

    Args:
        rows: of one run, the first vehicle in front; ``x`` is not looked at.
        options: ``dt``, ``fill``, ``max_error`` and the way of cutting.

    Returns:
        Sequences named ``run/number``, in order of time, the leader last.

    Raises:
        ConfigError: a ``dt`` or ``window`` that is no whole number of steps.
        DataError: times that are not equally spaced, or a vehicle twice at one time.
    """
    assert rows.v is not None
    assert rows.spacing is not None
    start, step, (speed, spacing) = _equally_spaced(rows, rows.v[:, 0], rows.spacing)
    most = int(options.fill / step + 1e-6)  # samples that may be missing
    v = _filled(speed, most)
    sound = _sound(rows, spacing, np.diff(v, axis=1), step, options.max_error)
    gap = _filled(sound, most)
    added = (np.isfinite(v) & np.isnan(speed)) | (np.isfinite(gap) & np.isnan(sound))
    way = np.stack([driven(step * np.arange(len(v)), column) for column in v.T], 1)
    every = 1 if options.dt is None else whole_steps("dt", options.dt, step)
    v, gap, way, added = v[::every], gap[::every], way[::every], added[::every]
    grid = Grid(step * every, start)
    # with the vehicle in front; the first has nobody there
    linked = np.isfinite(v) & np.isfinite(gap)
    linked[:, 1:] &= np.isfinite(v[:, :-1])
    linked[:, 0] = False
    first_rows = [int(of_vehicle[0]) for of_vehicle in grouped_rows(rows.agent)]
    table = replace(rows, x=rows.x[:, :1])
    sequences: list[Sequence] = []
    for first, last in _linked_intervals(linked, grid.dt, options):
        part = slice(first, last + 1)
        heads = np.flatnonzero(~linked[part].all(axis=0))
        for i, end in pairwise([*heads.tolist(), linked.shape[1]]):
            if end - i < options.min_vehicles or not np.isfinite(v[part, i]).all():
                continue
            front, platoon = way[part, i], []
            for n in range(i, end):
                front = front - (gap[part, n] + (options.length or 0.0) if n > i else 0.0)
                x, speeds = front[:, None], v[part, n, None]
                if options.smooth is not None:
                    x, speeds = smooth_columns(grid.dt * np.arange(len(x)), x, options.smooth)
                platoon.append(
                    Record(
                        str(rows.agent[first_rows[n]]),
                        first_rows[n],
                        first,
                        x,
                        speeds,
                        added[part, n],
                        np.zeros(len(x), dtype=bool),
                    )
                )
            name = f"{rows.name}/{len(sequences):03d}"
            sequences.append(sequence_of(name, table, platoon[::-1], first, last, grid))
    return sequences


def _equally_spaced(rows: Trajectories, *columns: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Time of the first sample, step (s), and each column as ``(K, N)``, NaN without a row."""
    time, at = np.unique(np.round(rows.time, 6), return_inverse=True)
    agent, names = pd.factorize(rows.agent)
    if len(time) < 2:
        raise DataError(f"{rows.path}: all rows of {rows.name} stand at one time")
    step = round(float(np.median(np.diff(time))), 9)
    number = (time - time[0]) / step
    if not (number[-1] + 1) * len(names) <= max(_CELLS, _SPARSE * len(rows)):
        raise DataError(
            f"{rows.path}: {len(rows)} rows of {len(names)} vehicles stand at times from "
            f"{time[0]:g} to {time[-1]:g} s in steps of {step:g} s; look for a time or a position "
            "that is wrong, or cut the file"
        )
    k = np.round(number).astype(int)
    odd = np.flatnonzero(np.abs(number - k) > 0.1)
    if odd.size:
        raise DataError(
            f"{rows.path}: the time {time[odd[0]]:g} s is no whole number of steps of {step:g} s "
            f"from the first, {time[0]:g} s"
        )
    shape = (int(k[-1]) + 1, len(names))
    cell = k[at] * shape[1] + agent
    if len(np.unique(cell)) < len(cell):
        raise DataError(
            f"{rows.path}: run {rows.name} has two rows of one position at one time; expected one "
            "row per vehicle and time"
        )
    wide = np.full((len(columns), shape[0] * shape[1]), np.nan)
    wide[:, cell] = columns
    return float(time[0]), step, wide.reshape(-1, *shape)


def _filled(values: np.ndarray, most: int) -> np.ndarray:
    """``(K, N)`` values with holes of at most ``most`` samples interpolated."""
    sample = pd.DataFrame(np.where(np.isnan(values), np.nan, np.arange(len(values))[:, None]))
    short = sample.bfill() - sample.ffill() <= most + 1
    whole = pd.DataFrame(values).interpolate(limit_area="inside")
    return whole.where(short).to_numpy()


def _sound(
    rows: Trajectories, spacing: np.ndarray, faster: np.ndarray, dt: float, most: float | None
) -> np.ndarray:
    """``(K, N)`` spacings without those that are none: not above 0, or between samples of which
    one contradicts the speeds by more than ``most`` m.

    Args:
        faster: ``(K, N - 1)`` m/s, how much faster each follower is than the vehicle in front.
    """
    sound = np.where(spacing > 0, spacing, np.nan)
    if most is not None:
        expected = -(faster[1:] + faster[:-1]) / 2 * dt
        off = np.abs(np.diff(sound[:, 1:], axis=0) - expected) > most
        sound[1:, 1:][off] = np.nan
        sound[:-1, 1:][off] = np.nan
    names = list(dict.fromkeys(rows.agent))
    bad = np.isfinite(spacing) & np.isnan(sound)
    for i in np.flatnonzero(bad.any(axis=0)):
        log.info(
            "%s: %d of %d gaps of %s to %s are not above 0, or change otherwise than their speeds "
            "tell (data.max_error); they count as unknown",
            rows.name,
            bad[:, i].sum(),
            np.isfinite(spacing[:, i]).sum(),
            names[i],
            names[i - 1],
        )
    return sound


def _linked_intervals(
    linked: np.ndarray, dt: float, options: OpenAccOptions
) -> Iterator[tuple[int, int]]:
    """First and last sample of windows, or of maximal intervals with the same links."""
    if options.window is not None:
        yield from windows(0, len(linked) - 1, whole_steps("window", options.window, dt))
        return
    changes = np.flatnonzero((linked[1:] != linked[:-1]).any(axis=1)) + 1
    for first, after in pairwise([0, *changes.tolist(), len(linked)]):
        if (after - 1 - first) * dt >= options.min_duration - 1e-6:
            yield first, after - 1


def check_laps(run: Trajectories) -> None:
    """Say what the laps of the foremost vehicle with coordinates tell of integrated speeds.

    Args:
        run: rows with coordinates (east and north, m) as positions.
    """
    located = np.flatnonzero(np.isfinite(run.x).all(axis=1))
    if not len(located) or run.v is None:
        return
    rows = np.flatnonzero(run.agent == run.agent[located[0]])
    rows = rows[np.argsort(run.time[rows], kind="stable")]
    with np.errstate(over="ignore", invalid="ignore"):  # of coordinates that are none
        by_speed, path = find_laps(driven(run.time[rows], run.v[rows, 0]), run.x[rows])
    if not len(by_speed):
        return
    text = (
        f"{run.name}: complete laps of {run.agent[located[0]]}: {len(by_speed)}, "
        f"{by_speed.min():.1f} to {by_speed.max():.1f} m by its speed, "
        f"{path.min():.1f} to {path.max():.1f} m by its coordinates"
    )
    # of a lap from the median, and of all laps from the coordinates
    ratios = np.append(by_speed / np.median(by_speed), by_speed.sum() / path.sum())
    if np.abs(ratios - 1).max() > CLOSED:
        log.warning("%s: they differ by more than %g %%", text, 100 * CLOSED)
    else:
        log.info("%s", text)


def find_laps(driven: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Complete laps between passes of the point where a vehicle is first known to be.

    Args:
        driven: ``(K,)`` m, integrated speed.
        place: ``(K, 2)`` m, coordinates; NaN where they are unknown.

    Returns:
        ``(L,)`` m per lap by integrated speed, and along the measured coordinates.
    """
    from scipy.signal import find_peaks  # loads scipy.stats, which takes a second

    located = np.flatnonzero(np.isfinite(place).all(axis=1) & np.isfinite(driven))
    if not len(located):
        return np.empty(0), np.empty(0)
    driven, place = driven[located], place[located]
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1))])
    start = int(np.argmax(driven - driven[0] > BACK))  # not while it stands before it starts
    apart = np.linalg.norm(place - place[start], axis=1)
    # from the start on, so that the vehicle is away before each of them and after it
    nearest, _ = find_peaks(-apart[start:], height=-BACK, prominence=AWAY - BACK)
    passes = [start, *(start + nearest).tolist()]
    # within a step the pass is where the way there and the way on are closest to the point
    at = [_along(place, i, place[start]) for i in passes]
    samples = np.arange(len(driven))
    return np.diff(np.interp(at, samples, driven)), np.diff(np.interp(at, samples, path))


def _along(place: np.ndarray, i: int, point: np.ndarray) -> float:
    """Where the track passes a point, in samples, near sample ``i``."""
    ahead = place[min(i + 1, len(place) - 1)] - place[max(i - 1, 0)]
    length = float(ahead @ ahead)
    steps = min(i + 1, len(place) - 1) - max(i - 1, 0)
    shift = float((point - place[i]) @ ahead) / length * steps if length else 0.0
    return i + float(np.clip(shift, -1.0, 1.0))
