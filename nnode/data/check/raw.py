"""Any file as a table of cells, or as a format that has a reader of its own."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nnode.data.readers.columns import Table
from nnode.data.readers.jupedsim import MAGIC
from nnode.data.readers.openacc import HEAD
from nnode.errors import ConfigError, DataError

#: Formats by their first bytes, each with the data source that reads it.
_MAGICS = {
    MAGIC: "jupedsim",
    b"MATLAB 5.0": "esimas",
    b"\x89HDF": "esimas",
    b"PAR1": "parquet",
    b"\x1f\x8b": "sumo",
}
#: So many bytes and lines are looked at to tell what a file is.
_BYTES, _LINES = 1 << 16, 20
_NUMBER = re.compile(r"[+-]?(\d+[.,]?\d*|[.,]\d+)(e[+-]?\d+)?|nan|inf", re.IGNORECASE)
_RATE = re.compile(r"(?:frame\s*rate|fps)\D{0,12}([\d.]+)", re.IGNORECASE)
_UNIT = re.compile(r"\bx\s*[/\[(]\s*(cm|m)\b", re.IGNORECASE)


@dataclass(frozen=True)
class Raw:
    """A file as it is.

    Attributes:
        path: of the file.
        native: the data source with a reader for exactly this format; empty: a table.
        table: the cells, None for a native format.
        named: whether the file names its columns.
        separator: ``,``, ``;``, tab, or a space for any white space; empty for Parquet.
        decimal: the sign between whole and broken part of numbers.
        rate: frames per second that a comment tells.
        unit: of positions that a comment tells, ``cm`` or ``m``.
        dated: columns of dates, clock times or durations; in ``table`` these are seconds.
    """

    path: Path
    native: str = ""
    table: Table | None = None
    named: bool = True
    separator: str = ","
    decimal: str = "."
    rate: float | None = None
    unit: str | None = None
    dated: tuple[str, ...] = ()


def read_raw(path: Path) -> Raw:
    """Look at a file.

    Raises:
        ConfigError: there is no such file.
        DataError: it is empty, no text, or no table; says which.
    """
    if path.is_dir():
        raise ConfigError(f"{path} is a folder; name one of its files")
    if not path.is_file():
        raise ConfigError(f"there is no file {path}; give the path of a table of trajectories")
    try:
        with path.open("rb") as file:
            start = file.read(_BYTES)
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror}") from error
    if not start.strip():
        raise DataError(f"{path} is empty; expected rows of trajectories")
    native = next((name for magic, name in _MAGICS.items() if start.startswith(magic)), "")
    if native == "parquet" or path.suffix.lower() in (".parquet", ".pq"):
        return Raw(path, table=_parquet(path), separator="")
    if native:
        return Raw(path, native)
    if b"\0" in start:
        raise DataError(
            f"{path} is no text (it holds zero bytes); expected CSV, Parquet, text of numbers, or "
            "a format that docs/data.md lists; save a text of UTF-16 as UTF-8"
        )
    text = start.decode("utf-8-sig", errors="replace")
    if text.lstrip().startswith("<"):
        return Raw(path, "sumo")
    if text.startswith(HEAD[0] + ","):
        return Raw(path, "openacc")
    return _text(path, text, whole=len(start) < _BYTES)


def _parquet(path: Path) -> Table:
    if path.suffix.lower() in (".parquet", ".pq"):
        return Table(path)
    raise DataError(f"{path} is a Parquet table; give it a name that ends in .parquet")


def _text(path: Path, text: str, whole: bool) -> Raw:
    lines = text.splitlines() if whole else text.splitlines()[:-1] or [text]
    said = "\n".join(line for line in lines if line.startswith("#"))
    rows = [line for line in lines if line.strip() and not line.startswith("#")][:_LINES]
    if not rows:
        raise DataError(f"{path} has no rows below its comments; expected rows of trajectories")
    separator = _separator(rows)
    cells = _cells(rows[0], separator)
    if len(cells) < 3:
        raise DataError(
            f"{path} is no table of trajectories: its first line {rows[0][:60]!r} has "
            f"{len(cells)} cell{'s' * (len(cells) > 1)}; expected at least an agent, a time and a "
            "position, separated by commas, semicolons, tabs or spaces"
        )
    named = not all(_NUMBER.fullmatch(cell) or not cell for cell in cells)
    later = [cell for row in rows[1:] for cell in _cells(row, separator)]
    comma = separator != "," and any("," in cell and _NUMBER.fullmatch(cell) for cell in later)
    how: dict[str, Any] = {"sep": r"\s+" if separator == " " else separator}
    how |= {"decimal": "," if comma else ".", "encoding_errors": "replace"}
    if said:
        # the rows' own lines are counted from the comments above them on
        above = next(i for i, line in enumerate(lines) if line.strip() and line[0] != "#")
        how |= {"comment": "#", "skiprows": above}
    names = None if named else [f"column {i + 1}" for i in range(len(cells))]
    rate, unit = _RATE.search(said), _UNIT.search(said)
    return Raw(
        path,
        table=Table(path, names, **how),
        named=named,
        separator=separator,
        decimal="," if comma else ".",
        rate=_positive(rate[1]) if rate else None,
        unit=unit[1].lower() if unit else None,
    )


def _positive(text: str) -> float | None:
    try:
        value = float(text.rstrip("."))
    except ValueError:
        return None
    return value if 0 < value < float("inf") else None


def _separator(rows: list[str]) -> str:
    """The sign of which every row has as many, at least two."""
    for sign in (";", "\t", ","):
        counts = {row.count(sign) for row in rows}
        if min(counts) >= 2 and len(counts) == 1:
            return sign
    # rows of unequal lengths: what the first line has
    most = max((",", ";", "\t"), key=rows[0].count)
    return most if rows[0].count(most) else " "


def _cells(row: str, separator: str) -> list[str]:
    parts = row.split() if separator == " " else row.split(separator)
    return [part.strip().strip('"') for part in parts]
