"""Any file as a table of cells, or as a format that has a reader of its own."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from nnode.data.readers.columns import Layout, Table, beginning, is_parquet, layout
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


@dataclass(frozen=True)
class Raw:
    """A file as it is.

    Attributes:
        path: of the file.
        native: the data source with a reader for exactly this format; empty: a table.
        table: the cells, None for a native format.
        layout: of a text.
        dated: columns of dates, clock times or durations; in ``table`` these are seconds.
    """

    path: Path
    native: str = ""
    table: Table | None = None
    layout: Layout = field(default_factory=Layout)
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

    @property
    def rate(self) -> float | None:
        """Frames per second that the file states, where a recording can have so many."""
        rate = self.layout.rate
        return rate if rate is not None and 0 < rate < float("inf") else None


def read_raw(path: Path) -> Raw:
    """Examine a file.

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
        return Raw(path, table=Table(path))
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
    return Raw(path, table=Table(path, encoding_errors="replace"), layout=form)
