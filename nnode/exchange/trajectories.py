"""Sequences, measured or simulated, as files that other programs read."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from nnode.calibrate.evaluate import Simulate
from nnode.data._arrow import open_writer, to_table
from nnode.data.sequence import Sequence, collate
from nnode.errors import DataError
from nnode.exchange.tables import write_csv
from nnode.files import replacing, write_text


@torch.no_grad()
def simulated(
    simulate: Simulate,
    sequences: Iterable[Sequence],
    *,
    size: int = 32,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str | None = None,
) -> Iterator[Sequence]:
    """The sequences as a model moves the agents from their first measured state.

    Velocities are the model's own in second-order models, else None. Where people walk to is
    what the simulation was told, also where that was their last measured position.

    Args:
        size: so many are simulated at once.
    """
    for group in _groups(sequences, size):
        path = simulate(collate(group).to(device, dtype))
        x = path.x.double().cpu().numpy()
        v = None if path.v is None else path.v.double().cpu().numpy()
        for b, s in enumerate(group):
            part = (slice(s.n_samples), b, slice(s.n_agents))
            yield replace(_directed(s), x=x[part], v=None if v is None else v[part])


def write_pedpy(folder: Path, sequences: Iterable[Sequence]) -> list[Path]:
    """Text as PedPy and the Jülich archive have it, one file per sequence, in m.

    Lines hold ``id frame x y z`` with z = 0; frames count sampling intervals, the first one is
    the sequence's start. Identifiers that are no whole numbers, or are not there, are counted
    from 1 in the order of the sequence, and listed in the file's head. Walls are not part of
    this format.

    Raises:
        DataError: a sequence of traffic, which has no second coordinate, or of one sample.
    """
    files: dict[str, Path] = {}
    for s in sequences:
        name = _file_name(s.name)
        while name in files:  # names may differ in signs that no file name has
            name += "_"
        files[name] = _pedpy_file(folder / f"{name}.txt", s)
    return list(files.values())


def write_parquet(path: Path, sequences: Iterable[Sequence], dims: int) -> Path:
    """The tidy table that ``data=table`` reads, with velocities where there are such.

    Args:
        path: of the table.
        sequences: one row per sequence, time and agent.
        dims: number of space dimensions.
    """
    with replacing(path) as temporary, open_writer(temporary, dims) as writer:
        for s in sequences:
            writer.write_table(to_table(_directed(s)))
    return path


def write_walls(path: Path, sequences: Iterable[Sequence]) -> tuple[Path | None, int]:
    """The walls that go with such a table, where all sequences have the same ones.

    Returns:
        The path, None where nothing is written, and the number of distinct sets.
    """
    known = {None if s.walls is None else s.walls.tobytes(): s.walls for s in sequences}
    (walls, *others) = known.values()
    if others or walls is None:
        return None, len(known)
    return write_csv(path, pd.DataFrame(walls, columns=["x1", "y1", "x2", "y2"])), 1


def _directed(s: Sequence) -> Sequence:
    """The sequence with destinations spelled out; a table's column is filled or absent."""
    return s if s.destination is not None else replace(s, destination=s.x[-1])


def _groups(sequences: Iterable[Sequence], size: int) -> Iterator[list[Sequence]]:
    group: list[Sequence] = []
    for s in sequences:
        group.append(s)
        if len(group) == size:
            yield group
            group = []
    if group:
        yield group


def _file_name(name: str) -> str:
    return "".join(sign if sign.isalnum() or sign in "-_.+" else "_" for sign in name)


def _pedpy_file(path: Path, s: Sequence) -> Path:
    if s.x.shape[2] != 2 or s.n_samples < 2:
        raise DataError(
            f"sequence {s.name}: PedPy's text needs two coordinates and two samples, found "
            f"{s.x.shape[2]} and {s.n_samples}; leave pedpy out of to="
        )
    own = [int(name) for name in s.agents if name.isascii() and name.isdigit() and len(name) < 10]
    numbered = len(own) == s.n_agents and len(set(own)) == len(own)
    ids = own if numbered else list(range(1, s.n_agents + 1))
    first = round(float(s.time[0]) / s.dt)
    # PedPy looks for the rate and for "x/cm" in every such line: the rate stands first
    head = [f"# framerate: {_rate(s.dt)}", f"# {_word(s.name)}, from {s.time[0]:.9g} s on"]
    if not numbered and s.agents:
        head += [f"# {i} is {_word(name)}" for i, name in zip(ids, s.agents, strict=True)]
    head.append("# id frame x/m y/m z/m")
    rows = [
        f"{i} {first + k} {x:.6f} {y:.6f} 0"
        for n, i in enumerate(ids)
        for k, (x, y) in enumerate(s.x[:, n])
    ]
    return write_text(path, "\n".join([*head, *rows]) + "\n")


def _word(name: str) -> str:
    return " ".join(name.replace("/", " ").split())


def _rate(dt: float) -> str:
    """Frames per second, without the noise of the times' last digits."""
    return np.format_float_positional(float(f"{1 / dt:.12g}"), trim="0")
