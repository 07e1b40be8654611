"""Any file as a table of cells, or as a format that has a reader of its own."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from nnode.data.readers.columns import Table, beginning, is_parquet, layout
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
        rate: frames per second that a comment states.
        unit: of positions that a comment states, ``cm`` or ``m``.
        dated: columns of dates, clock times or durations; in ``table`` these are seconds.
    """

    path: Path
    native: str = ""
    table: Table | None = None
    named: bool = True
    separator: str = ","
    rate: float | None = None
    unit: str | None = None
    dated: tuple[str, ...] = ()

    @property
    def cells(self) -> Table:
        """The table of a file that is one."""
        assert self.table is not None
        return self.table

    @property
    def frame(self) -> pd.DataFrame:
        """Its cells."""
        return self.cells.frame


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
    start = beginning(path)
    if not start.strip():
        raise DataError(f"{path} is empty; expected rows of trajectories")
    native = next((name for magic, name in _MAGICS.items() if start.startswith(magic)), "")
    if is_parquet(path):
        return Raw(path, table=Table(path), separator="")
    if native == "parquet":
        raise DataError(f"{path} is a Parquet table; give it a name that ends in .parquet")
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
    return _text(path, start)


def _text(path: Path, start: bytes) -> Raw:
    form = layout(start)
    if form is None:
        raise DataError(f"{path} has no rows below its comments; expected rows of trajectories")
    number = len(form.cells)
    if number < 3:
        raise DataError(
            f"{path} is no table of trajectories: its first line {form.first[:60]!r} has "
            f"{number} cell{'s' * (number > 1)}; expected at least an agent, a time and "
            "a position, separated by commas, semicolons, tabs or spaces"
        )
    rate, unit = _RATE.search(form.comments), _UNIT.search(form.comments)
    return Raw(
        path,
        table=Table(path, encoding_errors="replace"),
        named=form.named,
        separator=form.separator,
        rate=_positive(rate[1]) if rate else None,
        unit=unit[1].lower() if unit else None,
    )


def _positive(text: str) -> float | None:
    try:
        value = float(text.rstrip("."))
    except ValueError:
        return None
    return value if 0 < value < float("inf") else None
