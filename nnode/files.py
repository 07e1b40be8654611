"""Files that are written as a whole, and safe CSV and JSON."""

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

#: End of the names of files that are being written, ``.NAME.PROCESS.partial``.
PARTIAL = ".partial"

#: Largest depth of nested lists and mappings in a file; a configuration has fewer than 10 levels.
DEPTH = 100

#: Errors of the system for a full disk, and for missing permissions.
_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM}

#: Errors of the system for a file in the place of a folder, and the reverse.
_NO_FOLDER = {errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG}

#: Texts that a spreadsheet would evaluate as a formula, with or without an apostrophe before them.
_FORMULA = re.compile(r"'*[=+\-@\t\r\n]")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path in the same folder, whose file replaces ``path`` at the end.

    Missing folders are created. After an error, ``path`` is unchanged and the temporary file is
    removed.

    Raises:
        OSError: the folder cannot be created or written to.
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
    """Translate errors of the system for a full disk or missing permissions.

    Args:
        folder: folder to which the context writes.

    Raises:
        WriteError: a file cannot be written, or the folder is a file; other errors are not changed.
        DataError: a file exists, but its permissions do not allow reading.
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
                f"{error.filename} cannot be read: {error.strerror}; change its permissions"
            ) from error
        raise WriteError(
            f"{error.filename or folder} cannot be written: {error.strerror}. Earlier files are "
            "kept; make room on the disk, or choose another folder with hydra.run.dir="
        ) from error


def _shut(error: OSError) -> bool:
    """Whether an error concerns a file that exists and cannot be read."""
    place = error.filename
    return isinstance(place, str) and os.path.isfile(place) and not os.access(place, os.R_OK)


def file_name(text: str) -> str:
    """A name of a model or a recording as the stem of a file name.

    Path separators and control characters become ``_``, and leading points are removed. Names are
    cut to 100 characters, which leaves room for endings.
    """
    return re.sub(r"^\.+|[^\w .,+~'=()-]", "_", text)[:100] or "_"


def write_text(path: Path, text: str) -> Path:
    """Write a text file in UTF-8; returns its path."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def csv_text(frame: pd.DataFrame) -> str:
    """A data frame as CSV with full precision and without row numbers.

    Spreadsheets evaluate cells that begin with ``=``, ``+``, ``-`` or ``@``. Such texts and such
    names of columns get an apostrophe in front, which :func:`csv_cell` removes. Numbers do not
    change, nor do numbers that are stored as text.
    """
    from pandas import Series

    safe, texts = frame.copy(), [str(name) for name in frame.columns]
    for place, kind in enumerate(frame.dtypes):
        if kind.kind not in "biufcmM":  # numbers and times
            cells = [csv_safe(cell) for cell in frame.iloc[:, place]]
            texts += [cell for cell in cells if isinstance(cell, str)]
            safe.isetitem(place, Series(cells, frame.index, dtype=object).array)
    safe.columns = frame.columns.map(csv_safe)
    # pandas does not quote a carriage return, and would then read two rows
    if any("\r" in text for text in texts):
        return safe.to_csv(index=False, quoting=csv.QUOTE_NONNUMERIC)
    return safe.to_csv(index=False)


def write_csv(path: Path, frame: pd.DataFrame) -> Path:
    """Write a data frame as :func:`csv_text`; returns the path."""
    return write_text(path, csv_text(frame))


def csv_safe(cell: Any) -> Any:
    """A cell that a spreadsheet does not evaluate as a formula, see :func:`csv_text`."""
    if not isinstance(cell, str) or not _FORMULA.match(cell):
        return cell
    try:
        float(cell)
    except ValueError:
        return f"'{cell}"
    return cell


def csv_cell(text: str) -> str:
    """The text of a cell before :func:`csv_text`."""
    return text[1:] if text[:1] == "'" and _FORMULA.match(text) else text


def write_json(path: Path, content: dict[str, Any], indent: int | None = 2) -> Path:
    """Write JSON with NaN and infinities, which Python's reader accepts."""
    text = json.dumps(content, indent=indent, ensure_ascii=False, allow_nan=True)
    return write_text(path, text + "\n")


def interpolation(content: Any, most: float = math.inf) -> str | None:
    """The first text with ``${...}`` in nested lists and mappings; None if there is none.

    The configuration would replace such a text by other values, for example by environment
    variables. Therefore files from other sources must not contain it.

    Args:
        most: largest allowed number of values; a list that contains itself has infinitely many.

    Raises:
        ValueError: there are more values, or more than 100 levels.
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
