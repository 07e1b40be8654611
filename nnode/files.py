"""Files that are never half there."""

from __future__ import annotations

import csv
import errno
import json
import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nnode.errors import ConfigError, DataError, WriteError

if TYPE_CHECKING:
    import pandas as pd

#: Ends the names of files that are being written; ``.NAME.PROCESS`` stands before it.
PARTIAL = ".partial"

#: Levels of lists and mappings in what a file holds; a configuration has fewer than 10.
DEPTH = 100

#: What the system answers where there is no room, or where nothing may be written.
_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM}

#: What it answers where a file stands in place of a folder, or the other way round.
_NO_FOLDER = {errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG}


#: Texts that a spreadsheet takes for a formula, and those that were made safe already.
_FORMULA = re.compile(r"'*[=+\-@\t\r\n]")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A name beside ``path`` to write to; what was written takes its place at the end.

    Missing folders are made. After an error ``path`` is as it was before, and nothing is left.

    Raises:
        OSError: the folder cannot be made or written to.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}{PARTIAL}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        with suppress(OSError):
            temporary.unlink()


@contextmanager
def disk_words(folder: Path) -> Iterator[None]:
    """Say in words that a disk is full, or that nothing may be written.

    Args:
        folder: where the work inside writes.

    Raises:
        WriteError: for the system's errors of that kind, and where a file stands in place of the
            folder; all others pass.
        DataError: for a file that may not be read.
    """
    try:
        yield
    except OSError as error:
        if error.errno in _NO_FOLDER:
            raise WriteError(
                f"{folder} cannot be used as a folder: {error.strerror} "
                f"({error.filename or folder}); choose another one with hydra.run.dir="
            ) from error
        if error.errno not in _NO_ROOM:
            raise
        if _shut(error):
            raise DataError(
                f"{error.filename} cannot be read: {error.strerror}; allow it, or take another file"
            ) from error
        raise WriteError(
            f"{error.filename or folder} cannot be written: {error.strerror}. What was written "
            "before is kept; make room, or choose another folder with hydra.run.dir="
        ) from error


def _shut(error: OSError) -> bool:
    """Whether it is a file that is there, but may not be read."""
    place = error.filename
    return isinstance(place, str) and os.path.isfile(place) and not os.access(place, os.R_OK)


def file_name(text: str) -> str:
    """A name of a model or a recording as the stem of a file's name in one folder.

    Signs of paths and control characters become ``_``, and a name does not begin with a point.
    Names are cut to 100 characters, so that there is room for what a file's name ends with.
    """
    return re.sub(r"^\.+|[^\w .,+~'=()-]", "_", text)[:100] or "_"


def write_text(path: Path, text: str) -> Path:
    """Write a text file in UTF-8; returns its path."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def csv_text(frame: pd.DataFrame) -> str:
    """A data frame as CSV with full precision and without row numbers.

    Spreadsheets run cells that begin with ``=``, ``+``, ``-`` or ``@``. An apostrophe is put before
    such a text, and before such a name of a column; numbers, also those that are text, stay as they
    are. :func:`csv_cell` takes the apostrophe away.
    """
    from pandas import Series

    safe, texts = frame.copy(), [str(name) for name in frame.columns]
    for place, kind in enumerate(frame.dtypes):
        if kind.kind not in "biufcmM":  # numbers and times
            cells = [csv_safe(cell) for cell in frame.iloc[:, place]]
            texts += [cell for cell in cells if isinstance(cell, str)]
            safe.isetitem(place, Series(cells, frame.index, dtype=object).array)
    safe.columns = frame.columns.map(csv_safe)
    # pandas leaves a carriage return without quotes, and then reads two rows
    if any("\r" in text for text in texts):
        return safe.to_csv(index=False, quoting=csv.QUOTE_NONNUMERIC)
    return safe.to_csv(index=False)


def write_csv(path: Path, frame: pd.DataFrame) -> Path:
    """Write a data frame as :func:`csv_text`; returns the path."""
    return write_text(path, csv_text(frame))


def csv_safe(cell: Any) -> Any:
    """A cell that a spreadsheet does not take for a formula, see :func:`csv_text`."""
    if not isinstance(cell, str) or not _FORMULA.match(cell):
        return cell
    try:
        float(cell)
    except ValueError:
        return f"'{cell}"
    return cell


def csv_cell(text: str) -> str:
    """A cell's text as it was before :func:`csv_text`."""
    return text[1:] if text[:1] == "'" and _FORMULA.match(text) else text


def write_json(path: Path, content: dict[str, Any], indent: int | None = 2) -> Path:
    """Write JSON; NaN and infinities are kept, as Python's own reader takes them."""
    text = json.dumps(content, indent=indent, ensure_ascii=False, allow_nan=True)
    return write_text(path, text + "\n")


def interpolation(content: Any, most: float = math.inf) -> str | None:
    """The first text with ``${...}`` in nested lists and mappings; None where there is none.

    The configuration replaces such a text by other values, among them variables of the
    environment. What comes from a file of others must not contain it.

    Args:
        most: values that there may be; a list that contains itself has no end.

    Raises:
        ValueError: more values than that, or nested more than 100 deep.
    """
    waiting, number = [(content, 0)], 0
    while waiting:
        value, depth = waiting.pop()
        number += 1
        if number > most or depth > DEPTH:
            raise ValueError(f"more than {most:g} values, or nested more than {DEPTH} deep")
        if isinstance(value, str) and "${" in value:
            return value
        inner: Iterable[Any] = ()
        if isinstance(value, Mapping):
            inner = (part for item in value.items() for part in item)
        elif isinstance(value, list | tuple | set):
            inner = value
        waiting += [(part, depth + 1) for part in inner]
    return None


def xarray() -> Any:
    """The library xarray, which is optional.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        return import_module("xarray")
    except ImportError as error:
        raise ConfigError(
            "this needs xarray, which is not installed: pip install 'nnode[xarray]'"
        ) from error
