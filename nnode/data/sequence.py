"""One measured sequence, and the padded mini-batch that models are calibrated on."""

from __future__ import annotations

from collections.abc import Iterable
from collections.abc import Sequence as ListLike
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from torch import Tensor

from nnode.errors import DataError

Domain = Literal["traffic", "crowd"]
T = TypeVar("T")

#: Seconds by unit of time.
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
#: Metres by unit of length.
LENGTH_UNITS = {"m": 1.0, "ft": 0.3048, "cm": 0.01, "km": 1000.0}
#: m/s by unit of speed.
SPEED_UNITS = {"m/s": 1.0, "km/h": 1 / 3.6, "ft/s": 0.3048, "mph": 0.44704}
#: s; a sampling interval is at least the first and below the second. Cameras, radar and satellite
#: navigation take up to some hundred samples in a second. In ten seconds a car at 20 m/s drives
#: 200 m and a person walks 13 m, past everything that either reacts to. Times in milliseconds of
#: a recording with at most 100 samples in a second lie beyond the range, as do those in
#: microseconds, nanoseconds, and, below it, days.
SHORTEST, LONGEST = 1e-3, 10.0

#: Distance (m) between the padding vehicles that stand in front of a shorter platoon.
PADDING_GAP = 1e5
#: Fields of a batch that are positions. They stay in float64: numbers of float32 are 0.5 m apart
#: at 7,000 km, where the coordinates of maps lie.
_POSITIONS = ("x", "destination", "walls")
#: Fields of a sequence with a name, and with a number or a vector, of every agent.
_NAMES, _PER_AGENT = ("agents", "kind", "group"), ("length", "destination", "preferred")


def check_interval(dt: float, whose: str, remedy: str = "") -> None:
    """Refuse a sampling interval that no recording of vehicles or people has.

    Args:
        dt: s; NaN, of a single sample, is not judged.
        whose: what is sampled, which begins the message.
        remedy: how times in another unit are read; empty: with ``data.time_unit``.

    Raises:
        DataError: with the range, and the unit that the times probably have.
    """
    if not dt < SHORTEST and not dt >= LONGEST:  # NaN is not compared
        return
    unit = next((u for u, s in TIME_UNITS.items() if 0.01 <= dt * s <= 2), None)
    advice = remedy or f"give times in seconds, or their unit by data.time_unit={unit or 'UNIT'}"
    if unit and remedy:
        advice += f" (in {unit}, the interval would be {dt * TIME_UNITS[unit]:g} s)"
    elif not unit:
        advice += f" ({', '.join(TIME_UNITS)})"
    raise DataError(
        f"{whose}: samples are {dt:g} s apart; expected at least {SHORTEST:g} s, the finest that "
        f"recordings have, and less than {LONGEST:g} s, in which an agent passes everything that "
        f"it reacts to; {advice}"
    )


@dataclass(frozen=True, kw_only=True)
class Sequence:
    """Trajectories of N agents, all present at each of K equally spaced times.

    Attributes:
        name: unique within a data set, by convention ``recording/number``.
        recording: the recording (file, run) that the sequence was cut from.
        site: what recordings have in common whose clock and identifiers are the same, as the lanes
            of a road; empty: the recording is alone.
        time: ``(K,)`` s, equally spaced, as recorded (not shifted to zero).
        x: ``(K, N, D)`` positions in m, D = 1 (traffic) or 2 (crowd). Traffic is ordered
            along the lane: agent N - 1 leads.
        v: ``(K, N, D)`` velocities in m/s, or None; see :meth:`velocity`.
        agents: N identifiers, unique within the recording, or empty where the source has
            none. They decide which sequences share an agent.
        length: ``(N,)`` m, NaN where unknown, or None.
        kind: N class names (``car``, ``truck``, ...), or None.
        group: N names of social groups (empty string: walks alone), or None.
        destination: ``(N, D)`` m, or None for the last position.
        preferred: ``(N, D)`` m/s, mean velocity in the seconds before the sequence, NaN where
            nothing was measured then; or None.
        walls: ``(W, 4)`` segments x1, y1, x2, y2 in m with the walkable side on their
            left, or None.
        split: the side of the published division that it is on, ``train`` or ``test``; empty: the
            source publishes none.
        filled: number of samples that are missing in the source and were interpolated when it was
            read (``data.fill``).
    """

    name: str
    recording: str
    time: np.ndarray
    x: np.ndarray
    v: np.ndarray | None = None
    agents: tuple[str, ...] = ()
    length: np.ndarray | None = None
    kind: tuple[str, ...] | None = None
    group: tuple[str, ...] | None = None
    destination: np.ndarray | None = None
    preferred: np.ndarray | None = None
    walls: np.ndarray | None = None
    site: str = ""
    split: str = ""
    filled: int = 0

    def __post_init__(self) -> None:
        x = np.asarray(self.x, dtype=np.float64)
        time = np.asarray(self.time, dtype=np.float64)
        if x.ndim != 3:
            raise DataError(f"sequence {self.name}: x must be (K, N, D), got shape {x.shape}")
        if time.shape != (x.shape[0],):
            raise DataError(
                f"sequence {self.name}: time must be ({x.shape[0]},), got shape {time.shape}"
            )
        n, d = x.shape[1:]
        shapes = {"v": x.shape, "length": (n,), "destination": (n, d), "preferred": (n, d)}
        for field, shape in shapes.items():
            value = getattr(self, field)
            if value is None:
                continue
            value = np.asarray(value, dtype=np.float64)
            if value.shape != shape:
                raise DataError(f"sequence {self.name}: {field} must be {shape}, got {value.shape}")
            if field == "length" and (value <= 0).any():
                raise DataError(
                    f"sequence {self.name}: a length is {value[value <= 0][0]:g} m, expected "
                    "a positive number, or NaN where it is not known"
                )
            object.__setattr__(self, field, value)
        for field in _NAMES:
            value = getattr(self, field)
            if value and len(value) != n:
                raise DataError(
                    f"sequence {self.name}: {field} must name {n} agents, got {len(value)}"
                )
        object.__setattr__(self, "x", x)
        object.__setattr__(self, "time", time)

    @property
    def n_samples(self) -> int:
        """K, the number of sampling times."""
        return int(self.x.shape[0])

    @property
    def n_agents(self) -> int:
        """N, the number of agents."""
        return int(self.x.shape[1])

    @property
    def dt(self) -> float:
        """Sampling interval in s; NaN for a single sample."""
        if self.n_samples < 2:
            return float("nan")
        return float((self.time[-1] - self.time[0]) / (self.n_samples - 1))

    def velocity(self) -> np.ndarray:
        """``(K, N, D)`` m/s: the stored velocities, else forward differences of ``x``.

        The last sample repeats the last difference.
        """
        if self.v is not None:
            return self.v
        if self.n_samples < 2:
            return np.zeros_like(self.x)
        step = np.diff(self.x, axis=0) / self.dt
        return np.concatenate([step, step[-1:]])

    def part(self, first: float, last: float) -> Sequence:
        """The samples of a share of the sequence, from ``first`` to ``last``."""
        low, high = (int(share * self.n_samples) for share in (first, last))
        return replace(
            self,
            name=f"{self.name}/{low}-{high}",
            time=self.time[low:high],
            x=self.x[low:high],
            v=None if self.v is None else self.v[low:high],
        )

    def every(self, stride: int) -> Sequence:
        """The first, and then every ``stride``-th sample."""
        v = None if self.v is None else self.v[::stride]
        return replace(self, time=self.time[::stride], x=self.x[::stride], v=v)

    def select(self, keep: np.ndarray) -> Sequence:
        """The same sequence with only the agents where ``keep`` (N booleans) holds."""
        index = np.flatnonzero(keep)
        chosen: dict[str, Any] = {"x": self.x[:, index]}
        if self.v is not None:
            chosen["v"] = self.v[:, index]
        for field in _NAMES:
            if names := getattr(self, field):
                chosen[field] = tuple(names[i] for i in index)
        for field in _PER_AGENT:
            if (values := getattr(self, field)) is not None:
                chosen[field] = values[index]
        return replace(self, **chosen)


@dataclass(kw_only=True)
class Batch:
    """Sequences padded to the same length and the same number of agents.

    Tensors are (time, batch, agent, dim); B sequences, K samples, N agents, D dimensions.

    Attributes:
        dt: sampling interval in s, the same for all sequences of a batch.
        x: ``(K, B, N, D)`` measured positions, m, in float64. Padding vehicles stand PADDING_GAP
            apart in front of the leader, so that every gap stays finite; padding people stand
            still, far away from everyone.
        v: ``(K, B, N, D)`` measured velocities, m/s; 0 in the padding.
        valid: ``(K, B, N)`` True where a sample was measured.
        agent: ``(B, N)`` True where an agent is real. In traffic the last real one leads.
        start: ``(B,)`` time of the first sample, s.
        destination: ``(B, N, D)`` m.
        length: ``(B, N)`` m, NaN where unknown.
        walls: ``(B, W, 4)`` segments, m; NaN in the padding. W may be 0.
        names: names of the sequences.
        kind, group: per sequence the agents' class and group names, or None.
        preferred: ``(B, N, D)`` mean velocities before the sequences, m/s, NaN where nothing was
            measured then; None: nowhere.
    """

    dt: float
    x: Tensor
    v: Tensor
    valid: Tensor
    agent: Tensor
    start: Tensor
    destination: Tensor
    length: Tensor
    walls: Tensor
    names: tuple[str, ...]
    kind: tuple[tuple[str, ...] | None, ...] = ()
    group: tuple[tuple[str, ...] | None, ...] = ()
    preferred: Tensor | None = None

    @property
    def n_samples(self) -> int:
        """K, the number of samples of the longest sequence."""
        return int(self.x.shape[0])

    @property
    def dtype(self) -> torch.dtype:
        """The precision of simulations; positions are in float64 in any case."""
        return self.v.dtype

    def __len__(self) -> int:
        return int(self.x.shape[1])

    def to(
        self, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> Batch:
        """A copy on ``device`` for simulations in ``dtype``.

        Floating-point tensors are in ``dtype``, apart from positions, which stay in float64. A
        solver takes them relative to an origin of each sequence, see :meth:`relative_to`.
        """
        moved = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor):
                kind = dtype if value.is_floating_point() else None
                if kind is not None and field.name in _POSITIONS:
                    kind = torch.float64
                value = value.to(device, kind)
            moved[field.name] = value
        return Batch(**moved)

    def origins(self) -> Tensor:
        """``(B, D)`` m: of each sequence the middle of the measured positions, in whole metres.

        Whole metres are subtracted from float64 without rounding, so that a sequence which is
        moved by whole metres is the same problem.
        """
        measured, most = self.valid[..., None], torch.finfo(self.x.dtype).max
        low = self.x.detach().masked_fill(~measured, most).amin((0, 2))
        high = self.x.detach().masked_fill(~measured, -most).amax((0, 2))
        return ((low + high) / 2).round()

    def relative_to(self, origin: Tensor | None) -> Batch:
        """A copy with positions in the precision of simulations.

        Args:
            origin: ``(B, D)`` m, subtracted from all positions before they are rounded; None: 0.
        """
        moved = {name: getattr(self, name) for name in _POSITIONS}
        if origin is not None:
            moved["x"] = self.x - origin[:, None]
            moved["destination"] = self.destination - origin[:, None]
            # the segments of walls have two ends; lanes have none, whatever their D is
            ends = origin.repeat(1, 4 // origin.shape[1])
            moved["walls"] = self.walls - ends[:, None]
        return replace(self, **{name: value.to(self.dtype) for name, value in moved.items()})

    def select(self, places: list[int]) -> Batch:
        """The sequences at some places, padded as before."""
        second = ("x", "v", "valid")
        chosen: dict[str, Any] = {"dt": self.dt}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor):
                chosen[field.name] = value[:, places] if field.name in second else value[places]
            elif isinstance(value, tuple):
                chosen[field.name] = tuple(value[i] for i in places) if value else ()
        return Batch(**chosen)


def collate(sequences: Iterable[Sequence]) -> Batch:
    """Pad sequences to one :class:`Batch` (float64, CPU).

    Raises:
        DataError: no sequence, sampling intervals or dimensions that differ, or an interval that
            no recording has.
    """
    items = list(sequences)
    if not items:
        raise DataError("a batch needs at least one sequence, got none")
    first = items[0]
    check_interval(first.dt, f"sequence {first.name}", "give its times in seconds")
    for item in items[1:]:
        if not np.isclose(item.dt, first.dt, rtol=1e-6):
            raise DataError(
                f"sequences of one batch must share their sampling interval: {first.name} has "
                f"{first.dt:g} s, {item.name} {item.dt:g} s; prepare them as two data sets"
            )
        if item.x.shape[2] != first.x.shape[2]:
            raise DataError(f"{first.name} and {item.name} differ in their number of dimensions")
    k = max(item.n_samples for item in items)
    n = max(item.n_agents for item in items)
    b, d = len(items), first.x.shape[2]
    w = max(0 if item.walls is None else len(item.walls) for item in items)
    x, v = np.empty((k, b, n, d)), np.zeros((k, b, n, d))
    valid = np.zeros((k, b, n), dtype=bool)
    per_agent = {
        "length": np.full((b, n), np.nan),
        "destination": np.empty((b, n, d)),
        "preferred": np.full((b, n, d), np.nan),
    }
    walls = np.full((b, w, 4), np.nan)
    for i, item in enumerate(items):
        ki, ni = item.n_samples, item.n_agents
        x[:ki, i, :ni] = item.x
        x[ki:, i, :ni] = item.x[-1]
        x[:, i, ni:] = item.x.max() + PADDING_GAP * np.arange(1, n - ni + 1)[:, None]
        v[:ki, i, :ni] = item.velocity()
        valid[:ki, i, :ni] = True
        per_agent["destination"][i] = x[-1, i]
        for field, padded in per_agent.items():
            if (values := getattr(item, field)) is not None:
                padded[i, :ni] = values
        if item.walls is not None:
            walls[i, : len(item.walls)] = item.walls
    arrays = {"x": x, "v": v, "valid": valid, "agent": valid.any(axis=0), "walls": walls}
    arrays |= {"start": np.array([item.time[0] for item in items]), **per_agent}
    if all(item.preferred is None for item in items):
        del arrays["preferred"]
    return Batch(
        dt=first.dt,
        names=tuple(item.name for item in items),
        kind=tuple(item.kind for item in items),
        group=tuple(item.group for item in items),
        **{name: torch.from_numpy(array) for name, array in arrays.items()},
    )


def evenly(items: ListLike[T], number: int) -> list[T]:
    """At most ``number`` of the items, at equal steps."""
    chosen = np.linspace(0, len(items) - 1, min(number, len(items))).round().astype(int)
    return [items[i] for i in chosen]
