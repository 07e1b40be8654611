"""Measured or simulated sequences in file formats of other programs."""

from __future__ import annotations

import gzip
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import pandas as pd
import pyarrow as pa
import torch
from pyarrow.csv import CSVWriter

from nnode.calibrate.evaluate import Simulate
from nnode.data._arrow import open_writer, schema, to_table
from nnode.data.sequence import Sequence, collate
from nnode.errors import ConfigError, DataError
from nnode.files import csv_safe, replacing, write_csv, write_text

#: Format of trajectories to the domains that it supports.
FORMATS = {
    "parquet": ("traffic", "crowd"),
    "csv": ("traffic", "crowd"),
    "pedpy": ("crowd",),
    "fcd": ("traffic",),
}


@torch.no_grad()
def simulated(
    simulate: Simulate,
    sequences: Iterable[Sequence],
    *,
    size: int = 32,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str | None = None,
) -> Iterator[Sequence]:
    """The sequences as simulated by a model from their first measured states.

    Velocities are those of second-order models, or else None. Destinations are the simulation's,
    also if they are the last measured positions.

    Args:
        size: number of sequences that are simulated at once.
    """
    iterator = iter(sequences)
    while group := list(islice(iterator, size)):
        path = simulate(collate(group).to(device, dtype))
        x = path.x.double().cpu().numpy()
        v = None if path.v is None else path.v.double().cpu().numpy()
        for b, s in enumerate(group):
            part = (slice(s.n_samples), b, slice(s.n_agents))
            yield replace(_directed(s), x=x[part], v=None if v is None else v[part])


def check_format(option: str, name: str, domain: str) -> None:
    """Refuse an unknown format, or a format that does not support the domain.

    Args:
        option: name of the option, for the error message.
        name: the format.
        domain: ``traffic`` or ``crowd``.

    Raises:
        ConfigError: the format is not suitable.
    """
    if domain in FORMATS.get(name, ()):
        return
    fit = ", ".join(key for key, domains in FORMATS.items() if domain in domains)
    why = f"is not for {domain}" if name in FORMATS else "is unknown"
    raise ConfigError(f"{option}={name} {why}; for {domain} take one of {fit}")


def write_trajectories(
    folder: Path, stem: str, name: str, sequences: Iterable[Sequence], dims: int
) -> list[Path]:
    """Write files of one of the :data:`FORMATS`, which :func:`check_format` has accepted.

    Args:
        folder: folder, created if it is missing.
        stem: stem of the file, or name of the folder with a file per sequence.
        name: name of the format.
        dims: number of space dimensions.
    """
    if name == "pedpy":
        return write_pedpy(folder / "pedpy" / stem, sequences)
    if name == "fcd":
        return [write_fcd(folder / f"{stem}.xml.gz", sequences)]
    return [write_table(folder / f"{stem}.{name}", sequences, dims)]


def write_pedpy(folder: Path, sequences: Iterable[Sequence]) -> list[Path]:
    """Write text in the format of PedPy and the Jülich archive, one file per sequence, in m.

    Lines contain ``id frame x y z`` with z = 0. Frames count sampling intervals from the start of
    the recording. Identifiers that are missing or not whole numbers are replaced by numbers from 1
    in the order of the sequence, which the file's head lists. The format has no walls.

    Raises:
        DataError: a sequence has one coordinate, as in traffic, or one sample.
    """
    return [_pedpy_file(folder / f"{name}.txt", s) for name, s in _named(sequences)]


def write_fcd(path: Path, sequences: Iterable[Sequence]) -> Path:
    """Write vehicles as ``sumo --fcd-output`` does, XML in gzip, in s, m and m/s.

    Every sequence is a separate lane with its name, and vehicles have the names ``LANE.AGENT``.
    Speeds are written if a sequence has them.

    Source: SUMO's documentation, FCDOutput.
    """
    moments: defaultdict[float, list[tuple[Sequence, int, list[str]]]] = defaultdict(list)
    for lane, s in _named(sequences):
        agents = s.agents or tuple(map(str, range(s.n_agents)))
        heads = [f"id={quoteattr(f'{lane}.{name}')} lane={quoteattr(lane)}" for name in agents]
        if s.kind is not None:
            heads = [f"{a} type={quoteattr(b)}" for a, b in zip(heads, s.kind, strict=True)]
        if s.length is not None:
            attributes = [f' length="{m}"' if np.isfinite(m) else "" for m in s.length.tolist()]
            heads = [a + b for a, b in zip(heads, attributes, strict=True)]
        for k, t in enumerate(s.time.tolist()):
            moments[round(t, 9)].append((s, k, heads))
    with (
        replacing(path) as temporary,
        temporary.open("wb") as raw,
        # without file name and time in the header, for reproducible bytes
        gzip.GzipFile("", "wb", fileobj=raw, mtime=0) as file,
    ):
        file.write(b'<?xml version="1.0" encoding="UTF-8"?>\n<fcd-export>\n')
        for t in sorted(moments):
            rows = [row for moment in moments[t] for row in _vehicles(*moment)]
            file.write("\n".join([f'<timestep time="{t}">', *rows, "</timestep>\n"]).encode())
        file.write(b"</fcd-export>\n")
    return path


def _vehicles(s: Sequence, k: int, heads: list[str]) -> Iterator[str]:
    """XML elements of the sequence's vehicles at its k-th time."""
    speeds = [""] * s.n_agents if s.v is None else [f' speed="{v}"' for v in s.v[k, :, 0].tolist()]
    for head, x, speed in zip(heads, s.x[k, :, 0].tolist(), speeds, strict=True):
        yield f'<vehicle {head} pos="{x}"{speed}/>'


def write_table(path: Path, sequences: Iterable[Sequence], dims: int) -> Path:
    """Write the tidy table that ``data=table`` reads, with velocities if there are any.

    Args:
        path: path of the table, ``.csv`` or else Parquet.
        sequences: one row per sequence, time and agent.
        dims: number of space dimensions.
    """
    text = path.suffix == ".csv"
    with replacing(path) as temporary:
        writer = CSVWriter(temporary, schema(dims)) if text else open_writer(temporary, dims)
        with writer:
            for s in sequences:
                table = to_table(_directed(s))
                writer.write_table(_safe(table) if text else table)
    return path


def _safe(table: pa.Table) -> pa.Table:
    """The table with escaped texts that a spreadsheet would read as formulas."""
    for i, field in enumerate(table.schema):
        if pa.types.is_string(field.type) and table[i].null_count < table.num_rows:
            cells = pa.array(map(csv_safe, table[i].to_pylist()), field.type)
            table = table.set_column(i, field, cells)
    return table


def write_walls(path: Path, sequences: Iterable[Sequence]) -> tuple[Path | None, int]:
    """Write the walls for such a table, if all sequences have the same walls.

    Returns:
        The path, or None if nothing is written; and the number of distinct sets of walls.
    """
    distinct = {None if s.walls is None else s.walls.tobytes(): s.walls for s in sequences}
    (walls, *others) = distinct.values()
    if others or walls is None:
        return None, len(distinct)
    return write_csv(path, pd.DataFrame(walls, columns=["x1", "y1", "x2", "y2"])), 1


def _directed(s: Sequence) -> Sequence:
    """The sequence with explicit destinations, since a table's column is complete or absent."""
    return s if s.destination is not None else replace(s, destination=s.x[-1])


def _named(sequences: Iterable[Sequence]) -> Iterator[tuple[str, Sequence]]:
    """Sequences with unique names that are valid for files and SUMO's lanes."""
    taken: set[str] = set()
    for s in sequences:
        name = "".join(sign if sign.isalnum() or sign in "-_.+~" else "_" for sign in s.name)
        while name in taken:  # replaced characters may cause clashes
            name += "_"
        taken.add(name)
        yield name, s


def _pedpy_file(path: Path, s: Sequence) -> Path:
    if s.x.shape[2] != 2 or s.n_samples < 2:
        raise DataError(
            f"sequence {s.name}: PedPy's text needs two coordinates and two samples, found "
            f"{s.x.shape[2]} and {s.n_samples}; take another format"
        )
    numbers = [
        int(name) for name in s.agents if name.isascii() and name.isdigit() and len(name) < 10
    ]
    numbered = len(numbers) == s.n_agents and len(set(numbers)) == len(numbers)
    ids = numbers if numbered else list(range(1, s.n_agents + 1))
    first = round(float(s.time[0]) / s.dt)
    # PedPy searches every line of the head for the rate and for "x/cm", so the rate comes first
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
