"""Columns of a user's table, checked: which exist, which rows hold no number."""

from __future__ import annotations

import difflib
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from nnode.data.options import one_of, positive
from nnode.data.sequence import LENGTH_UNITS, SPEED_UNITS, TIME_UNITS
from nnode.data.trajectories import Trajectories
from nnode.errors import ConfigError, DataError
from nnode.files import csv_cell

#: Whole numbers below this are exact as floating-point numbers.
EXACT = 2.0**53
#: s; times beyond this (three years) count from a calendar's origin. Float64 resolves them to
#: 1e-8 s and less, which is a relative error of 1e-6 in intervals of 0.02 s.
EPOCH = 1e8
#: Whole numbers below this are 64 bits long.
_WHOLE = 2.0**63


#: So many bytes and lines are looked at to tell how a text is laid out.
LOOKED_AT, _LINES = 1 << 16, 20
#: Endings of Parquet tables.
PARQUET = (".parquet", ".pq")
#: A cell of a text that is a number.
NUMBER = re.compile(r"[+-]?(\d+[.,]?\d*|[.,]\d+)(e[+-]?\d+)?|nan|inf", re.IGNORECASE)
#: Frames per second, and the unit of positions, as comments state them.
_RATE = re.compile(
    r"(?:frame\s*rate|fps)\D{0,12}?([+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)", re.IGNORECASE
)
_UNIT = re.compile(r"\b(?:x\s*[/\[(]|in)\s*(cm|m)\b", re.IGNORECASE)


@dataclass
class ColumnOptions:
    """Columns and units of any table.

    ``columns`` names the table's columns by what they mean, as each reader lists them. A column
    that bears the name of its meaning need not be listed; null leaves an optional one out.
    """

    columns: dict[str, str | None] = field(default_factory=dict)  # {meaning: column}
    position_unit: str = "m"  # m | ft | cm | km, of positions, lengths and destinations
    time_unit: str = "s"  # s | ms | us | ns | frame; dates and durations need none
    frame_rate: float | None = None  # 1/s, with time_unit=frame


@dataclass(frozen=True)
class Layout:
    """How a text holds a table.

    Attributes:
        first: its first row.
        cells: of that row.
        separator: ``,``, ``;``, tab, or a space for any white space; empty for tables that are no
            text.
        names: of the columns, where the first row holds none: those of the last comment, else
            ``column 1``, ...; None: the first row holds them.
        named: whether the names are the file's own.
        rate: frames per second that a comment states.
        unit: of positions that a comment states, ``cm`` or ``m``.
        options: of :func:`pandas.read_csv`.
    """

    first: str = ""
    cells: list[str] = field(default_factory=list)
    separator: str = ""
    names: list[str] | None = None
    named: bool = True
    rate: float | None = None
    unit: str | None = None
    options: dict[str, Any] = field(default_factory=dict)


def is_parquet(path: Path) -> bool:
    """Whether a file's name says that it is a Parquet table."""
    return path.suffix.lower() in PARQUET


def beginning(path: Path) -> bytes:
    """The first bytes of a file.

    Raises:
        DataError: it cannot be read.
    """
    try:
        with path.open("rb") as file:
            return file.read(LOOKED_AT)
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror}") from error


def layout(start: bytes) -> Layout | None:
    """How a text holds a table; None of one without rows.

    Args:
        start: the :func:`beginning` of the text.
    """
    text = start.decode("utf-8-sig", errors="replace")
    lines = text.splitlines()
    if len(start) == LOOKED_AT:  # the last line may not be whole
        lines = lines[:-1] or [text]
    comments = [line for line in lines if line.startswith("#")]
    rows = [line for line in lines if line.strip() and not line.startswith("#")][:_LINES]
    if not rows:
        return None
    separator = _separator(rows)
    cells = _cells(rows[0], separator)
    named = not all(NUMBER.fullmatch(cell) or not cell for cell in cells)
    later = [cell for row in rows[1:] for cell in _cells(row, separator)]
    comma = separator != "," and any("," in cell and NUMBER.fullmatch(cell) for cell in later)
    names = None if named else [f"column {i + 1}" for i in range(len(cells))]
    if not named and comments and separator != " ":
        said = _cells(comments[-1].lstrip("# "), separator)
        if len(said) == len(cells) and not any(NUMBER.fullmatch(cell) for cell in said):
            names, named = said, True
    options: dict[str, Any] = {
        "sep": r"\s+" if separator == " " else separator,
        "decimal": "," if comma else ".",
    }
    if comments:  # the rows' own lines are counted from the comments above them on
        options |= {"comment": "#", "skiprows": lines.index(rows[0])}
    rate, unit = _RATE.search("\n".join(comments)), _UNIT.search("\n".join(comments))
    return Layout(
        first=rows[0],
        cells=cells,
        separator=separator,
        names=names,
        named=named,
        rate=float(rate[1]) if rate else None,
        unit=unit[1].lower() if unit else None,
        options=options,
    )


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


class Table:
    """A table whose cells are asked for by meaning.

    Args:
        source: a file, ``.parquet`` or ``.pq`` read as Parquet, all else as text, see
            :class:`Layout`; or a data frame.
        names: of the columns of a text without a line of names.
        csv: further options of :func:`pandas.read_csv`; with ``sep`` or ``skiprows`` among them the
            layout is not looked for.

    Attributes:
        path: of the file; a data frame, which has none, is called ``table``.

    Raises:
        DataError: no such file, an empty one, or one that is not of its format.
    """

    def __init__(
        self, source: Path | pd.DataFrame, names: list[str] | None = None, **csv: Any
    ) -> None:
        if isinstance(source, pd.DataFrame):
            self.path, self.by_line = Path("table"), False
            self._take(source.reset_index(drop=True))
        else:
            self.path = source
            self._read(source, names, csv)

    def _read(self, path: Path, names: list[str] | None, csv: dict[str, Any]) -> None:
        parquet = is_parquet(path)
        self.by_line = not parquet
        if not path.is_file():
            raise DataError(f"there is no table {path}; set data.path, or data.source, to it")
        if not parquet and names is None and not {"sep", "skiprows"} & csv.keys():
            form = layout(beginning(path))
            if form is not None:
                names, csv = form.names, form.options | csv
        self._first = (2 if names is None else 1) + int(csv.get("skiprows", 0))
        try:
            if parquet:
                frame = pd.read_parquet(path).reset_index(drop=True)
            else:
                named = {} if names is None else {"names": names}
                # Blank lines are kept at first, so that row numbers are those of the file.
                how: dict[str, Any] = {
                    "low_memory": False,
                    "skip_blank_lines": False,
                    **csv,
                    **named,
                }
                frame = pd.read_csv(path, **how)
        except pd.errors.EmptyDataError as error:
            raise DataError(f"{path} is empty; expected a line of column names and rows") from error
        except Exception as error:  # a damaged file leads to almost any error
            kind = "Parquet" if parquet else "comma-separated"
            said = str(error).strip().removeprefix("Error tokenizing data. C error: ")
            raise DataError(f"{path} cannot be read as a {kind} table: {said}") from error
        if not isinstance(frame.index, pd.RangeIndex):
            raise DataError(
                f"{path}: there are more cells in its rows than names in its first line; give "
                "every column a name"
            )
        self._take(frame)

    def _take(self, frame: pd.DataFrame) -> None:
        self.frame = frame
        self.rename([str(name).strip() for name in frame.columns])
        self.frame = self.frame.dropna(how="all")
        if self.frame.empty:
            raise DataError(f"{self.path} has no rows below its columns {self._listing()}")

    def rename(self, names: list[str]) -> None:
        """Give the columns other names.

        Raises:
            DataError: two columns of one name.
        """
        twice = [name for name, number in Counter(names).items() if number > 1]
        if twice:
            raise DataError(
                f"{self.path} has {names.count(twice[0])} columns {twice[0]!r}; give every column "
                "a name of its own"
            )
        self.frame = self.frame.set_axis(names, axis=1)

    def __len__(self) -> int:
        return len(self.frame)

    def choose(
        self,
        required: Iterable[str],
        optional: Iterable[str] = (),
        names: Mapping[str, str | None] | None = None,
    ) -> dict[str, str]:
        """Names of the table's columns by meaning.

        Args:
            required: meanings that must have a column.
            optional: meanings that may have one.
            names: the configured map of meaning to column; a meaning that is not in it is
                looked for by its own name, None leaves an optional one out.

        Raises:
            ConfigError: the map names an unknown meaning, or leaves a required one out.
            DataError: a column that should be there is not.
        """
        mapped = names is not None
        names = dict(names or {})
        required, optional = tuple(required), tuple(optional)
        for key in names:
            if key not in required + optional:
                raise ConfigError(
                    f"data.columns.{key} is unknown; expected {', '.join(required + optional)}"
                )
        chosen = {}
        for key in required + optional:
            if key in names and names[key] is None:
                if key in required:
                    raise ConfigError(f"data.columns.{key} is null, but {key} is needed")
                continue
            column = names.get(key) or key
            if column in self.frame.columns:
                chosen[key] = column
            elif key in required or key in names:
                raise DataError(self._missing(key, column, mapped=mapped))
        return chosen

    def numbers(self, column: str, *, empty: bool = False) -> np.ndarray:
        """The column as ``(rows,)`` float64.

        Args:
            column: name in the table.
            empty: whether cells may be empty (they become NaN).

        Raises:
            DataError: a cell without a finite number; names the row.
        """
        cells = self.frame[column]
        if cells.dtype.kind in "mM":
            raise DataError(
                f"{self.path}: column {column!r} holds dates or durations; expected numbers"
            )
        values = floats(cells)
        bad = ~np.isfinite(values)
        if empty:
            bad &= ~cells.isna().to_numpy()
        further = f" (and {bad.sum() - 1} more rows)" if bad.sum() > 1 else ""
        self.refuse(
            bad,
            lambda i: (
                f"column {column!r} holds {_shown(cells, i)}{further}; expected a finite number"
            ),
        )
        return values

    def positive(self, column: str) -> np.ndarray:
        """The column as ``(rows,)`` float64 above 0; empty cells, of what is unknown, are NaN.

        Raises:
            DataError: a cell with another value; names the row.
        """
        values = self.numbers(column, empty=True)
        self.refuse(
            values <= 0,
            lambda i: (
                f"column {column!r} holds {values[i]:g}; expected a positive number, or an "
                "empty cell where it is not known"
            ),
        )
        return values

    def instants(self, column: str) -> np.ndarray | None:
        """Dates, clock times or durations as ``(rows,)`` whole nanoseconds; None of numbers.

        Dates and times of day in a text are those of ISO 8601 (``2020-01-31 08:00:00.2``,
        ``08:00:00.2``). Dates without a time zone are taken as of one.

        Raises:
            DataError: a cell that is none of them, in a column without a number; names the row.
        """
        cells = self.frame[column]
        if cells.dtype.kind not in "mM":
            if np.isfinite(np.array(pd.to_numeric(cells, errors="coerce"), dtype=float)).any():
                return None
            cells = cells.astype("string")
        try:
            instants = self._instants(cells).dt.as_unit("ns")
        except (ValueError, OverflowError) as error:  # beyond the years that nanoseconds count
            raise DataError(
                f"{self.path}: column {column!r} holds no dates of our time: {error}"
            ) from error
        self.refuse(
            instants.isna().to_numpy(),
            lambda i: (
                f"column {column!r} holds {_shown(cells.astype('string').str[:40], i)}; "
                "expected seconds, or dates (2020-01-31 08:00:00.2), clock times (08:00:00.2) or "
                "durations in all rows"
            ),
        )
        return np.asarray(instants.astype("int64"))

    @staticmethod
    def _instants(cells: pd.Series) -> pd.Series:
        """Dates, else clock times and durations, as far as cells hold such."""
        if cells.dtype.kind == "m":
            return cells
        dates = pd.to_datetime(cells, utc=True, format="ISO8601", errors="coerce")
        if dates.notna().any():
            return dates
        # a text without a colon would count as nanoseconds
        clock = cells.where(cells.str.contains(":").fillna(False).astype(bool))
        return pd.to_timedelta(clock, errors="coerce")

    def times(self, column: str, unit: float = 1.0) -> tuple[int, np.ndarray]:
        """The column as times: an origin, and ``(rows,)`` seconds after it.

        Args:
            column: name in the table; of numbers, dates, clock times or durations.
            unit: s, of numbers.

        Returns:
            The origin in ns: of dates the first one, of numbers 0, or the first one of those in
            ms, us or ns since 1970.

        Raises:
            DataError: a cell without such; names the row.
        """
        instants = self.instants(column)
        if instants is not None:
            first = int(instants.min())
            return first, (instants - first) / 1e9
        values = self.numbers(column)
        whole = pd.api.types.is_integer_dtype(self.frame[column])
        if whole and np.abs(values).max() < _WHOLE:
            return _since_first(self.frame[column].to_numpy(dtype=np.int64), unit)
        return _since_first(values, unit)

    def measured(self, column: str) -> np.ndarray:
        """The column as ``(rows,)`` float64, NaN where a cell is empty: a missing sample.

        Raises:
            DataError: a cell that holds something else than a finite number, or all are empty.
        """
        values = self.numbers(column, empty=True)
        return values if np.isfinite(values).any() else self.numbers(column)

    def names(self, column: str, *, empty: bool = False) -> np.ndarray:
        """The column as ``(rows,)`` text; whole numbers are written without a decimal point.

        Args:
            column: name in the table.
            empty: whether cells may be empty (they become empty text).

        Raises:
            DataError: an empty cell; names the row.
        """
        cells = self.frame[column]
        absent = cells.isna().to_numpy()
        self.refuse(
            absent & (not empty), lambda _: f"column {column!r} is empty; expected a name or number"
        )
        whole = pd.api.types.is_float_dtype(cells) and (cells.dropna() % 1 == 0).all()
        if whole and (cells.dropna().abs() < EXACT).all():
            cells = cells.astype("Int64")
        try:
            text = cells.astype("string").fillna("")
            marked = text.str.startswith("'") if self.by_line else np.zeros(1, dtype=bool)
            if marked.any():
                text = text.where(~marked, text[marked].map(csv_cell))
            # NumPy takes text with zero characters behind it for the same text without them
            text = text.str.rstrip("\0").str.strip()
        except (TypeError, ValueError):  # bytes that are no text, or lists in cells
            filled = map(int, np.flatnonzero(~absent))
            i = next((i for i in filled if not _is_text(cells, i)), 0)
            raise DataError(
                f"{self.path}, {self.row(i)}: column {column!r} holds {_shown(cells, i)}; "
                "expected a name or number"
            ) from None
        return np.asarray(text, dtype=object)

    def check_constant(self, column: str, values: np.ndarray, owner: np.ndarray, rule: str) -> None:
        """Refuse a value that changes within what it belongs to.

        Args:
            values: ``(rows,)`` of the column.
            owner: ``(rows,)`` numbers from 0 of what they belong to.
            rule: what is expected, in words.

        Raises:
            DataError: names the row.
        """
        first = np.unique(owner, return_index=True)[1][owner]
        self.refuse(
            (values != values[first]) & ~(pd.isna(values) & pd.isna(values[first])),
            lambda i: (
                f"column {column!r} holds {values[i]!s}, before it {values[first[i]]!s}; {rule}"
            ),
        )

    def refuse(self, wrong: np.ndarray, text: Callable[[int], str]) -> None:
        """Refuse the table for the first row in which something is wrong.

        Args:
            wrong: ``(rows,)`` whether it is.
            text: of the message, by the number of the row.

        Raises:
            DataError: names the row.
        """
        if wrong.any():
            i = int(np.argmax(wrong))
            raise DataError(f"{self.path}, {self.row(i)}: {text(i)}")

    def row(self, i: int) -> str:
        """Where the i-th row stands in the file, in words."""
        index = int(self.frame.index[i])
        return f"line {index + self._first}" if self.by_line else f"row {index + 1}"

    def _listing(self) -> str:
        return ", ".join(self.frame.columns) or "none"

    def _missing(self, key: str, column: str, mapped: bool) -> str:
        near = difflib.get_close_matches(column, self.frame.columns, n=1, cutoff=0.5)
        example = near[0] if near else "COLUMN"
        text = f"{self.path} has no column {column!r}; it has: {self._listing()}"
        if near:
            text += f"; did you mean {near[0]!r}?"
        if mapped:
            return text + f"; set data.columns.{key}={example}"
        return text + f"; rename the column that holds it to {key!r}"


def floats(cells: pd.Series) -> np.ndarray:
    """A column's cells ``(rows,)`` as float64, NaN where they hold no real number."""
    try:
        numbers = pd.to_numeric(cells, errors="coerce")
        if numbers.dtype.kind == "c":  # which would lose its imaginary part
            return np.full(len(cells), np.nan)
        return np.array(numbers, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):  # such as whole numbers beyond float64
        return np.array([_float(cell) for cell in cells])


def _float(cell: Any) -> float:
    try:
        return float(cell)
    except (TypeError, ValueError, OverflowError):
        return np.nan


def _is_text(cells: pd.Series, i: int) -> bool:
    try:
        pd.Series([cells.iloc[i]], dtype=object).astype("string")
    except (TypeError, ValueError):
        return False
    return True


def _shown(cells: pd.Series, i: int) -> str:
    """A cell for messages."""
    try:
        return "nothing" if cells.isna().iloc[i] else quoted(cells.iloc[i])
    except ValueError:
        return "bytes that are no text"


def quoted(cell: Any) -> str:
    """A cell for messages; whole numbers of thousands of digits cannot be written."""
    try:
        return repr(str(cell))
    except ValueError:
        return "a number that is too large"


def _since_first(values: np.ndarray, unit: float) -> tuple[int, np.ndarray]:
    """Numbers of a unit of time as seconds after an origin.

    Args:
        values: ``(rows,)``, whole or floating-point.
        unit: s.

    Returns:
        The origin in ns, and ``(rows,)`` s after it. It is 0, and for units below a second and
        times since 1970 (beyond :data:`EPOCH`) the first of them, as their differences would be
        rounded otherwise.
    """
    first = values.min()
    if unit == 1.0 or first * unit < EPOCH:
        return 0, values * unit
    return round(int(first) * (unit * 1e9)), (values - int(first)) * unit


def joined(columns: list[np.ndarray]) -> np.ndarray:
    """``(rows,)`` the names of some columns in one."""
    return np.array([" ".join(cells) for cells in zip(*columns, strict=True)], dtype=object)


def opened(source: Path | str | Table) -> Table:
    """A table by its path; one that is open already is taken as it is."""
    return source if isinstance(source, Table) else Table(Path(source))


def seconds_per_unit(options: ColumnOptions) -> float:
    """Seconds in a unit of a table's times.

    Raises:
        ConfigError: an unknown unit, or frames without their rate.
    """
    scale = one_of("time_unit", options.time_unit, {**TIME_UNITS, "frame": np.nan})
    if options.time_unit == "frame":
        scale = 1.0 / positive("frame_rate", options.frame_rate)
    return scale


def table_rows(
    table: Table,
    names: Mapping[str, str],
    options: ColumnOptions,
    axes: tuple[str, ...] = ("x",),
) -> Trajectories:
    """The columns of any table, by what they mean.

    Rows of different recordings, or of different sequences, never meet: both are the name of the
    recording.

    Args:
        names: of the columns by their meaning.
        axes: meanings of the positions' columns.

    Raises:
        ConfigError: an unknown unit.
        DataError: cells that are missing or hold no number; names the row.
    """
    metres = one_of("position_unit", options.position_unit, LENGTH_UNITS)

    def words(key: str) -> np.ndarray | None:
        return table.names(names[key], empty=True) if key in names else None

    v = length = None
    if "speed" in names:
        unit = one_of("speed_unit", getattr(options, "speed_unit", "m/s"), SPEED_UNITS)
        v = np.abs(table.numbers(names["speed"]))[:, None] * unit
    if "length" in names:
        own_unit = getattr(options, "length_unit", None) or options.position_unit
        length = table.positive(names["length"]) * one_of("length_unit", own_unit, LENGTH_UNITS)
    parts = [table.names(names[key]) for key in ("recording", "sequence") if key in names]
    return Trajectories(
        path=table.path,
        name=table.path.stem,
        where=table.row,
        agent=table.names(names["vehicle" if "vehicle" in names else "agent"]),
        time=table.times(names["time"], seconds_per_unit(options))[1],
        x=np.stack([table.measured(names[axis]) for axis in axes], -1) * metres,
        v=v,
        recording=joined(parts) if parts else None,
        lane=table.names(names["lane"]) if "lane" in names else None,
        length=length,
        kind=words("kind"),
        group=words("group"),
    )
