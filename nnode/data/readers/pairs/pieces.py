"""Pairs cut in time: equally spaced samples, windows, and the sequences that they are."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nnode.data.options import Gaps, PairOptions
from nnode.data.readers.columns import Table
from nnode.data.sequence import Sequence
from nnode.errors import ConfigError, DataError

#: Share of the sampling interval by which a step may deviate.
UNEVEN = 0.01


@dataclass(frozen=True)
class Pair:
    """A pair's rows in one file, in order of time, and what belongs to it as a whole.

    ``time`` (s) counts from ``origin`` (ns).
    """

    table: Table
    rows: np.ndarray
    words: dict[str, str]
    origin: int
    time: np.ndarray
    x: np.ndarray
    v: np.ndarray | None
    length: np.ndarray

    @property
    def called(self) -> str:
        return f"{self.table.path}: pair {self.words['pair']}"


def too_short(pair: Pair, options: PairOptions) -> str:
    """Why there is no sequence of a pair."""
    if len(pair.time) < options.min_samples:
        return f"fewer than data.min_samples={options.min_samples} times"
    if options.window is not None:
        return f"no data.window={options.window:g} s without a gap"
    return f"no data.min_samples={options.min_samples} times without a gap"


_Piece = tuple[np.ndarray, np.ndarray, np.ndarray | None]


def pieces_of(pair: Pair, options: PairOptions) -> Iterator[_Piece]:
    """Times, positions and speeds of every part without a gap."""
    if len(pair.time) < options.min_samples:
        return
    step = np.diff(pair.time)
    usual = float(np.median(step))
    gaps = np.flatnonzero(np.abs(step - usual) > UNEVEN * usual)
    if gaps.size and options.gaps is Gaps.error:
        i = int(gaps[0])
        raise DataError(
            f"{pair.called} steps from {pair.time[i]:g} s to {pair.time[i + 1]:g} s "
            f"({pair.table.row(int(pair.rows[i + 1]))}), expected steps of {usual:g} s "
            f"({len(gaps)} such gaps); data.gaps=cut cuts the pair there"
        )
    for rows in np.split(np.arange(len(pair.time)), gaps + 1):
        if len(rows) < 2:
            continue
        time, x, v = pair.time[rows], pair.x[rows], None if pair.v is None else pair.v[rows]
        dt = usual
        if options.dt is not None:
            dt = options.dt
            if dt < usual * (1 - UNEVEN):
                raise ConfigError(
                    f"data.dt={dt:g} s is finer than the {usual:g} s of {pair.called}; expected no "
                    "more times than were measured"
                )
            first, last = np.ceil(time[0] / dt - 1e-6), np.floor(time[-1] / dt + 1e-6)
            grid = np.arange(first, last + 1) * dt
            x = _at(grid, time, x)
            v = None if v is None else _at(grid, time, v)
            time = grid
        yield from _windows(time, x, v, dt, options)


def _at(grid: np.ndarray, time: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(grid, time, column) for column in values.T], -1)


def _windows(
    time: np.ndarray, x: np.ndarray, v: np.ndarray | None, dt: float, options: PairOptions
) -> Iterator[_Piece]:
    """Consecutive windows that share their boundary sample; what is left at the end is not used."""
    starts, steps = [0], len(time) - 1
    if options.window is not None:
        steps = round(options.window / dt)
        if steps < 1 or abs(options.window / dt - steps) > 1e-6 * steps:
            raise ConfigError(
                f"data.window={options.window:g} s is no whole number of steps of {dt:g} s"
            )
        starts = list(range(0, len(time) - steps, steps))
    for first in starts:
        rows = slice(first, first + steps + 1)
        if len(time[rows]) >= options.min_samples:
            yield time[rows], x[rows], None if v is None else v[rows]


def sequence_of(
    name: str,
    number: int,
    pieces: int,
    pair: Pair,
    time: np.ndarray,
    x: np.ndarray,
    v: np.ndarray | None,
    options: PairOptions,
) -> Sequence:
    words = pair.words
    # one without an identifier is in no other pair
    agents = tuple(words.get(who) or f"{words['pair']} {who}" for who in ("follower", "leader"))
    kinds = {str(code): str(called) for code, called in dict(options.kinds).items()}
    codes = (words.get("follower_kind", ""), words.get("leader_kind", ""))
    kind = tuple(kinds.get(code, code) for code in codes)
    return Sequence(
        name=name if pieces == 1 else f"{name}_{number:03d}",
        recording=words["run"],
        time=time,
        x=x[:, :, None],
        v=None if v is None else v[:, :, None],
        agents=agents,
        length=None if np.isnan(pair.length).all() else pair.length,
        kind=kind if any(kind) else None,
        split=words.get("split", "").lower(),
    )
