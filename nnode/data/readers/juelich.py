"""Reader of the Jülich archive's trajectory text files: people in a corridor, one row a frame.

Lines hold ``id frame x y z``; lines with ``#`` may tell the frame rate and the unit. The axes
stay as they are in the file.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Mapping
from fnmatch import fnmatch
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd

from nnode.data.exits import Exit, destinations, exits_of, read_exits
from nnode.data.options import JuelichOptions, Velocity, one_of, positive
from nnode.data.readers.recordings import raw_files
from nnode.data.sequence import Sequence
from nnode.data.smooth import fill, smooth_records
from nnode.errors import ConfigError, DataError

#: Units of the coordinates, with their size in m.
UNITS = {"cm": 0.01, "m": 1.0}

#: A table of frames and people may hold so many cells, or so many times its rows.
_FRAMES, _SPARSE = 10**8, 1000
#: From the first frame to the last there may be so many, or ten times those with somebody in them.
_PAUSES = 10**5

#: Frames per second beyond which a file is in error.
FASTEST = 1e6

_AXES = {"x": 0, "y": 1}
_NAME = re.compile(r"(.+)\.txt")


def juelich_files(options: JuelichOptions) -> dict[str, Path]:
    """Path of each wanted recording's file, see :func:`nnode.data.readers.recordings.raw_files`."""
    return raw_files(options, default="juelich", pattern=_NAME, file_name=lambda r: f"{r}.txt")


def read_juelich(path: Path, options: JuelichOptions) -> list[Sequence]:
    """Read one file and cut it into consecutive sequences of ``t_seq`` seconds.

    Neighbouring sequences share their boundary sample: with 25 frames per second and
    ``t_seq=1`` each has 26 samples. Only people who are tracked in every frame of a sequence
    (and inside ``view`` in every frame) are part of it.

    Args:
        path: text file.
        options: duration, frame rate, unit, walking axis, walls, view and velocities.

    Returns:
        Sequences named ``recording/number`` after the file, with people's ids as agents, their
        last position, or a point of their exit, as destination, and the corridor's two walls. ``v``
        is None with forward differences, which are what :meth:`Sequence.velocity` computes.

    Raises:
        ConfigError: an option out of its range, a ``t_seq`` that is no whole number of frames,
            a frame rate or unit that is unknown or contradicts the file.
        DataError: lines that are no trajectory (names the line), or no sequence at all.

    Source: Forschungszentrum Jülich, DOI 10.34735/ped.2013.5 (bi_corr) and the HERMES runs.
    """
    path = Path(path)
    table, rate = load_people(path, options)
    return cut_people(path, table, rate, options)


def cut_people(
    path: Path,
    table: pd.DataFrame,
    rate: float,
    options: JuelichOptions,
    walls: np.ndarray | None = None,
) -> list[Sequence]:
    """Cut tracked people into consecutive sequences, see :func:`read_juelich`.

    Args:
        path: the file they come from; its stem names the recording.
        table: rows id, frame (whole numbers), x, y (m).
        rate: frames per second.
        options: duration, history, walking axis, walls, view and velocities.
        walls: ``(W, 4)`` m, in place of ``options.walls``.

    Raises:
        ConfigError: an option out of its range.
        DataError: one person twice in a frame, or no sequence at all.
    """
    axis = int(one_of("walking_axis", options.walking_axis, _AXES))
    view = _interval("view", options.view)
    if not 0 < rate <= FASTEST:
        raise DataError(
            f"{path}: a frame rate of {rate:g} frames/s; expected a positive number of at most "
            f"{FASTEST:g}: correct it in the file"
        )
    if not 0 <= options.history < math.inf:
        raise ConfigError(f"data.history={options.history}: expected a number of seconds, or 0")
    steps = positive("t_seq", options.t_seq) * rate
    if round(steps) < 1 or abs(steps - round(steps)) > 1e-6:
        nearest = max(round(steps), 1) / rate
        raise ConfigError(
            f"data.t_seq={options.t_seq:g} s is {steps:g} frames at the {rate:g} frames/s of "
            f"{path.name}; expected a whole number, such as t_seq={nearest:g}"
        )
    _check_once(path, table)
    _check_dense(path, table)
    frames, ids, x = _positions(table)
    x, filled = fill(x, 1 / rate, options.fill)
    if options.smooth is not None:
        x = smooth_records(x, 1 / rate, positive("smooth", options.smooth))
    v = _velocity(x, rate, options.velocity)
    if walls is None:
        walls = _walls(path.stem, options.walls, axis, x, view)
    exits = _exits(path, read_exits(options.exits), x, ids)
    inside = np.isfinite(x[:, :, axis])
    if view is not None:
        with np.errstate(invalid="ignore"):
            inside &= (x[:, :, axis] >= view[0]) & (x[:, :, axis] <= view[1])
    found: list[Sequence] = []
    for first in range(0, len(frames) - round(steps), round(steps)):
        rows = slice(first, first + round(steps) + 1)
        people = np.flatnonzero(inside[rows].all(axis=0))
        if len(people) < max(options.min_agents, 1):
            continue
        positions = x[rows][:, people]
        before = first - round(options.history * rate)
        found.append(
            Sequence(
                name=f"{path.stem}/{len(found):03d}",
                recording=path.stem,
                time=frames[rows] / rate,
                x=positions,
                v=None if v is None else v[rows][:, people],
                agents=tuple(str(ids[i]) for i in people),
                destination=destinations([exits[i] for i in people], positions[0])
                if exits
                else positions[-1],
                preferred=_before(x[[before, first]][:, people], rate / (first - before))
                if 0 <= before < first
                else None,
                walls=walls,
                filled=int(filled[rows][:, people].sum()),
            )
        )
    if not found:
        raise DataError(
            f"{path}: no sequence; nowhere are {max(options.min_agents, 1)} people present for "
            f"{options.t_seq:g} s ({len(ids)} people, {len(frames) / rate:g} s in all); lower "
            "data.t_seq or data.min_agents, widen data.view, or leave it out of data.recording"
        )
    return found


def _exits(path: Path, exits: list[Exit], x: np.ndarray, ids: np.ndarray) -> list[Exit]:
    """Everybody's exit by where he is first and last seen in the file, or an empty list."""
    if not exits:
        return []
    known = np.isfinite(x).all(axis=2)
    column = np.arange(x.shape[1])
    first = x[known.argmax(axis=0), column]
    last = x[len(x) - 1 - known[::-1].argmax(axis=0), column]
    try:
        return exits_of(exits, first, last, [str(i) for i in ids])
    except DataError as error:
        raise DataError(f"{path}: {error}") from error


def _interval(option: str, value: list[float] | None) -> tuple[float, float] | None:
    if value is None:
        return None
    numbers = [float(item) for item in value]
    if len(numbers) != 2 or not numbers[0] < numbers[1]:
        raise ConfigError(f"data.{option}={numbers}: expected [low, high] in m, low below high")
    return numbers[0], numbers[1]


def load_people(path: Path, options: JuelichOptions) -> tuple[pd.DataFrame, float]:
    """Rows id, frame, x, y (m) of a text file, and its frame rate (1/s).

    Raises:
        ConfigError: a frame rate or unit that is unknown or contradicts the file.
        DataError: no such file, or lines that are no trajectory (names the line).
    """
    rate = options.frame_rate
    if rate is not None:
        positive("frame_rate", rate)
    if options.unit is not None:
        one_of("unit", options.unit, UNITS)
    if not path.is_file():
        raise DataError(f"there is no file {path}")
    pedpy = _pedpy()
    words = {"cm": pedpy.TrajectoryUnit.CENTIMETER, "m": pedpy.TrajectoryUnit.METER}
    try:
        trajectory = pedpy.load_trajectory(
            trajectory_file=path,
            default_frame_rate=rate,
            default_unit=None if options.unit is None else words[options.unit],
        )
    except (pedpy.errors.PedPyError, ValueError, OverflowError) as error:
        _check_lines(path)
        raise ConfigError(
            f"{path}: the header and data.frame_rate={rate}, data.unit={options.unit} do not "
            f"settle the frame rate and the unit: {error} Set data.frame_rate (1/s) and "
            "data.unit (cm, m) where the header lacks them, and to null where it tells them"
        ) from error
    table = trajectory.data[["id", "frame", "x", "y"]].reset_index(drop=True)
    if not np.isfinite(table[["x", "y"]].to_numpy()).all():
        _check_lines(path)
    return table, float(trajectory.frame_rate)


def _check_once(path: Path, table: pd.DataFrame) -> None:
    twice = table.duplicated(["id", "frame"])
    if twice.any():
        row = table[twice].iloc[0]
        raise DataError(
            f"{path}: person {row.id:g} stands twice in frame {row.frame:g} "
            f"({int(twice.sum())} such rows); expected one row per person and frame"
        )


def _check_dense(path: Path, table: pd.DataFrame) -> None:
    """Refuse a stray frame number before a table of all frames is made for it."""
    frame = table["frame"]
    span = int(frame.max()) - int(frame.min()) + 1
    stray = span > max(_PAUSES, 10 * frame.nunique())
    if stray or span * table["id"].nunique() > max(_FRAMES, _SPARSE * len(table)):
        raise DataError(
            f"{path}: {len(table)} rows stand in frames {frame.min()} to {frame.max()}; expected "
            "consecutive frame numbers: look for one that is wrong, or cut the file"
        )


def _pedpy() -> ModuleType:
    """PedPy, which is slow to load and would set up the logging of the whole program."""
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    import pedpy

    root.handlers[:] = handlers
    root.setLevel(level)
    return pedpy


def _check_lines(path: Path) -> None:
    """Find the line that is no trajectory.

    Raises:
        DataError: always, unless every line holds id, frame, x, y.
    """
    rows = 0
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        for number, line in enumerate(file, start=1):
            words = line.split("#")[0].split()
            if not words:
                continue
            rows += 1
            try:
                good = len(words) >= 4 and all(math.isfinite(float(w)) for w in words[:4])
                good = good and all(float(w).is_integer() for w in words[:2])
            except ValueError:
                good = False
            if not good:
                raise DataError(
                    f"{path}, line {number}: expected 'id frame x y z', whole numbers and then "
                    f"coordinates, found {line.strip()[:80]!r}"
                )
    if rows == 0:
        raise DataError(f"{path} is empty; expected lines of 'id frame x y z'")


def _positions(table: pd.DataFrame) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All frames from first to last, ids, and positions (frames, people, 2), NaN where absent."""
    ids, column = np.unique(table["id"].to_numpy(), return_inverse=True)
    frame = table["frame"].to_numpy()
    frames = np.arange(frame.min(), frame.max() + 1)
    x = np.full((len(frames), len(ids), 2), np.nan)
    x[frame - frames[0], column] = table[["x", "y"]].to_numpy()
    return frames, ids, x


def _velocity(x: np.ndarray, rate: float, scheme: Velocity) -> np.ndarray | None:
    """Velocities (m/s) over the whole trajectory; one-sided where a neighbour is absent."""
    if scheme is Velocity.forward:
        return None
    step = np.diff(x, axis=0) * rate
    edge = np.full_like(x[:1], np.nan)
    ahead, behind = np.concatenate([step, edge]), np.concatenate([edge, step])
    one_sided = np.where(np.isnan(behind), ahead, behind)
    if scheme is Velocity.backward:
        return one_sided
    central = (ahead + behind) / 2
    return np.where(np.isnan(central), one_sided, central)


def _before(x: np.ndarray, rate: float) -> np.ndarray | None:
    """Mean velocities (m/s) between two moments, ``rate`` (1/s) apart, of those who were there."""
    found: np.ndarray = (x[1] - x[0]) * rate
    return found if np.isfinite(found).any() else None


def _walls(
    recording: str,
    walls: Mapping[str, list[float]],
    axis: int,
    x: np.ndarray,
    view: tuple[float, float] | None,
) -> np.ndarray | None:
    """Both walls, as long as the view or else the data, the corridor on the left of each."""
    patterns = [name for name in walls if name == recording]
    patterns += [name for name in walls if fnmatch(recording, name)]
    if not patterns:
        return None
    sides = _interval(f"walls.{patterns[0]}", walls[patterns[0]])
    assert sides is not None
    start, end = view or (np.nanmin(x[:, :, axis]), np.nanmax(x[:, :, axis]))
    # Walking along y instead of x mirrors the plane, and with it left and right.
    low, high = ((start, end), (end, start)) if axis == 0 else ((end, start), (start, end))
    segments = np.empty((2, 4))
    for row, side, (begin, stop) in zip(segments, sides, (low, high), strict=True):
        row[axis], row[2 + axis] = begin, stop
        row[1 - axis] = row[3 - axis] = side
    return segments
