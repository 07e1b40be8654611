"""Reader of the Jülich archive's trajectory text files: people in a corridor, one row a frame.

Lines hold ``id frame x y z``; lines with ``#`` may tell the frame rate and the unit. The axes
stay as they are in the file.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from nnode.data.cut import Reading, by_presence, sequence_of, uneven_text
from nnode.data.exits import exits_of, read_exits
from nnode.data.options import DataOptions, one_of, positive
from nnode.data.readers.columns import EXACT, Table, beginning, floats, layout
from nnode.data.readers.recordings import natural, raw_files
from nnode.data.sequence import Sequence
from nnode.data.trajectories import Grid, Record, Trajectories, grouped_rows, records
from nnode.errors import ConfigError, DataError

#: Units of the coordinates, and how many of them are a metre.
UNITS = {"cm": 100.0, "m": 1.0}

#: Columns of a recording of people.
COLUMNS = ("id", "frame", "x", "y")

#: From the first frame to the last there may be so many, or ten times those with somebody in them.
_PAUSES = 10**5

#: Frames per second beyond which a file is in error.
FASTEST = 1e6

_AXES = {"x": 0, "y": 1}
_NAME = re.compile(r"(.+)\.txt")

#: Rows of people, and their sampling interval (s).
People = tuple[Trajectories, float]


class Velocity(str, Enum):
    """Finite difference that velocities are computed with.

    ``forward`` looks only at the positions of the sequence itself; ``central`` and ``backward``
    use the neighbouring frames of the whole trajectory where there are such.
    """

    forward = "forward"
    central = "central"
    backward = "backward"


@dataclass
class JuelichOptions(DataOptions):
    """Trajectory text files of the Jülich archive: id frame x y z."""

    name: str = "juelich"
    domain: str = "crowd"
    fill: float = 0.0  # the published recordings as they are
    t_seq: float = 1.0  # s, length of a sequence
    frame_rate: float | None = None  # 1/s; null reads it from the file's header
    unit: str | None = None  # cm | m; null reads it from the file's header
    walking_axis: str = "x"  # x | y; walls run along it
    walls: dict[str, list[float]] = field(default_factory=dict)  # recording: [low, high], m
    view: list[float] | None = None  # [from, to] along the walking axis, m; null takes all
    velocity: Velocity = Velocity.forward
    min_agents: int = 1  # fewest people in a sequence
    # {name: {line: [x1, y1, x2, y2], direction: +x}}, m: destinations on exit lines, by where
    # people walk (+x | -x | +y | -y | [x, y]); null: their last position in the sequence
    exits: Any = None
    # s before a sequence in which preferred velocities are measured, for model.desired=direction;
    # 0 measures none. Who is not tracked so long before has the velocity of his first sample
    history: float = 1.0


def juelich_files(options: JuelichOptions) -> dict[str, Path]:
    """Path of each wanted recording's file, see :func:`nnode.data.readers.recordings.raw_files`."""
    return raw_files(options, default="juelich", pattern=_NAME, file_name=lambda r: f"{r}.txt")


def read_juelich(path: Path, options: JuelichOptions) -> Reading:
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
    return cut_people(load_people(Path(path), options), options, None)


def cut_people(people: People, options: JuelichOptions, walls: np.ndarray | None) -> Reading:
    """Cut a recording of people, whatever file it comes from, see :func:`read_juelich`.

    Args:
        people: their rows.
        walls: ``(W, 4)`` segments, or None for those of ``options.walls``.

    Raises:
        ConfigError: an option out of its range.
        DataError: one person twice at one time, or no sequence at all.
    """
    rows, dt = people
    path, axis = rows.path, int(one_of("walking_axis", options.walking_axis, _AXES))
    view = _interval("view", options.view)
    if not 0 <= options.history < math.inf:
        raise ConfigError(f"data.history={options.history}: expected a number of seconds, or 0")
    number = positive("t_seq", options.t_seq) / dt
    steps = round(number)
    if steps < 1 or abs(number - steps) > 1e-3:
        raise ConfigError(
            f"data.t_seq={options.t_seq:g} s is {number:g} frames at the {1 / dt:g} frames/s of "
            f"{path.name}; expected a whole number, such as t_seq={max(steps, 1) * dt:g}"
        )
    if walls is None:
        walls = _walls(path.stem, options.walls, axis, rows.x, view)
    sequences: list[Sequence] = []
    notes: list[str] = []
    for (name,), of_recording in rows.parts("recording"):
        recording = name or rows.name
        grid = Grid(dt, float(of_recording.time.min()))
        every = records(of_recording, grid, fill=options.fill, smoothing=options.smooth)
        every = [_with_velocity(record, dt, options) for record in every]
        notes += uneven_text(every, dt)
        of_people = grouped_rows(of_recording.agent, time=of_recording.time)
        exits = read_exits(options.exits)
        goals_by_row = exits_of(exits, of_recording, of_people) if exits else ()
        goals = {of_recording.agent[row]: goal for row, goal in goals_by_row}
        before = round(options.history / dt)
        for number, (present, first, last) in enumerate(
            by_presence(every, steps, max(options.min_agents, 1), axis, view)
        ):
            present.sort(key=lambda record: natural(record.agent))
            at = first if goals else last
            x = {record.agent: record.x[at - record.first] for record in present}
            # nearest points of exits, or the last positions of the sequence
            goal = [goals[who].point(x[who]) if goals else x[who] for who in x]
            sequences.append(
                sequence_of(
                    f"{recording}/{number:03d}",
                    of_recording,
                    present,
                    first,
                    last,
                    grid,
                    recording=recording,
                    destination=np.stack(goal),
                    preferred=_before(every, present, first, before, dt),
                    walls=walls,
                )
            )
    if not sequences:
        span = float(rows.time.max() - rows.time.min()) + dt
        raise DataError(
            f"{path}: no sequence; nowhere are {max(options.min_agents, 1)} people present for "
            f"{options.t_seq:g} s ({len(set(rows.agent))} people, {span:g} s in all); lower "
            "data.t_seq or data.min_agents, widen data.view, or leave it out of data.recording"
        )
    return Reading(sequences, notes=notes)


def _with_velocity(record: Record, dt: float, options: JuelichOptions) -> Record:
    """A record with velocities as the options ask for them; smoothed ones stay."""
    scheme, x = options.velocity, record.x
    if options.smooth is not None or scheme is Velocity.forward or len(x) < 2:
        return record
    step = np.diff(x, axis=0) / dt
    ahead, behind = np.concatenate([step, step[-1:]]), np.concatenate([step[:1], step])
    return replace(record, v=behind if scheme is Velocity.backward else (ahead + behind) / 2)


def _interval(option: str, value: list[float] | None) -> tuple[float, float] | None:
    if value is None:
        return None
    numbers = [float(item) for item in value]
    if len(numbers) != 2 or not numbers[0] < numbers[1]:
        raise ConfigError(f"data.{option}={numbers}: expected [low, high] in m, low below high")
    return numbers[0], numbers[1]


def load_people(path: Path, options: JuelichOptions) -> People:
    """The rows of a text file, and its sampling interval.

    Raises:
        ConfigError: a frame rate or unit that is unknown or contradicts the file.
        DataError: no such file, or lines that are no trajectory (names the line).
    """
    if options.frame_rate is not None:
        positive("frame_rate", options.frame_rate)
    if options.unit is not None:
        one_of("unit", options.unit, UNITS)
    if not path.is_file():
        raise DataError(f"there is no file {path}")
    form = layout(beginning(path))
    if form is None:
        raise DataError(f"{path} is empty; expected lines of 'id frame x y z'")
    rate = _settled(path, "frame_rate", "1/s", options.frame_rate, form.rate)
    unit = _settled(path, "unit", "cm, m", options.unit, form.unit)
    further = [f"column {i + 1}" for i in range(len(COLUMNS), len(form.cells))]
    csv = form.options | {"sep": r"\s+", "comment": "#", "encoding_errors": "replace"}
    return people_of(Table(path, [*COLUMNS, *further], **csv), rate, UNITS[unit])


_Stated = TypeVar("_Stated", float, str)


def _settled(
    path: Path, option: str, values: str, given: _Stated | None, stated: _Stated | None
) -> _Stated:
    """What an option or a file's header states.

    Args:
        values: that the option may have, for messages.

    Raises:
        ConfigError: neither states it, or each something else.
    """
    value = given if stated is None else stated
    if value is None:
        raise ConfigError(
            f"{path} states no {option.replace('_', ' ')}: set data.{option} ({values})"
        )
    if given not in (None, value):
        raise ConfigError(
            f"data.{option}={given}, but the header of {path} states {stated}; set data.{option} "
            "to null, or correct the header"
        )
    return value


def people_of(table: Table, rate: float, per_metre: float = 1.0) -> People:
    """Rows of a table with :data:`COLUMNS` and so many frames per second.

    Args:
        per_metre: how many units of the coordinates are a metre.

    Raises:
        DataError: cells that are no trajectory (names the row), a rate that no recording has, or
            frames far away from the others.
    """
    path = table.path
    values = np.stack([floats(table.frame[name]) for name in COLUMNS], axis=1)
    whole = values[:, :2]
    good = np.isfinite(values).all(axis=1)
    good &= ((whole == np.round(whole)) & (np.abs(whole) < EXACT)).all(axis=1)

    def expected(i: int) -> str:
        cells = " ".join(map(str, table.frame[list(COLUMNS)].iloc[i]))
        return f"expected 'id frame x y', whole numbers and then coordinates, found {cells[:80]!r}"

    table.refuse(~good, expected)
    if not 0 < rate <= FASTEST:
        raise DataError(
            f"{path}: a frame rate of {rate:g} frames/s; expected a positive number of at most "
            f"{FASTEST:g}: correct it in the file"
        )
    frame = values[:, 1]
    if np.ptp(frame) >= max(_PAUSES, 10 * len(np.unique(frame))):
        raise DataError(
            f"{path}: {len(table)} rows stand in frames {frame.min():.0f} to {frame.max():.0f}; "
            "expected consecutive frame numbers: look for one that is wrong, or cut the file"
        )
    rows = Trajectories(
        path=path,
        name=path.stem,
        where=lambda i: f"frame {frame[i]:.0f}",
        agent=table.names("id"),
        time=frame / rate,
        x=values[:, 2:] / per_metre,
    )
    return rows, 1 / rate


def _before(
    every: list[Record], present: list[Record], first: int, steps: int, dt: float
) -> np.ndarray | None:
    """Mean velocities (m/s) of people so many steps before a time, NaN of who was not tracked."""
    at = first - steps
    if not steps or at < min(record.first for record in every):
        return None
    then = {r.agent: r.x[at - r.first] for r in every if r.first <= at <= r.last}
    nowhere = np.full(2, np.nan)
    velocity: np.ndarray = np.stack(
        [(r.x[first - r.first] - then.get(r.agent, nowhere)) / (steps * dt) for r in present]
    )
    return velocity if np.isfinite(velocity).any() else None


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
    sides = _interval(f"walls.{patterns[0]}", walls[patterns[0]]) if patterns else None
    if sides is None:
        return None
    low, high = sides
    start, end = view or (np.nanmin(x[:, axis]), np.nanmax(x[:, axis]))
    segments = np.array([[start, low, end, low], [end, high, start, high]])
    # Walking along y instead of x mirrors the plane, and with it left and right.
    return segments if axis == 0 else segments[:, ::-1]
