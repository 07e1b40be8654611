"""Tables as text for HTML and Markdown, and in full precision as CSV."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import groupby
from numbers import Integral, Real
from typing import Any

import numpy as np
import pandas as pd

from nnode.errors import printable
from nnode.files import csv_text

#: Characters that are markup in Markdown: links, images, code, emphasis, and the end of a cell.
_MARKS = re.compile(r"[\\`*\[!|]|(?<!\w)_|_(?!\w)")
_ENTITY = re.compile(r"&(?=#?\w+;)")

#: A number, an interval or a number with its error, as text.
_NUMBER = re.compile(r"[+\-−±≤≥<>~ ]*\d[\d.,%±+\-−≤≥<>~\[\] e∞]*(to [\d.]+)?")

#: Default number of digits after the point.
DIGITS = 2

#: Numbers from this value on are written with a power of ten.
_LARGE = 1e7

NOTHING = "–"


@dataclass(frozen=True)
class Cell:
    """A cell of text that spans ``span`` columns."""

    text: str
    bold: bool = False
    right: bool = False
    span: int = 1


@dataclass(frozen=True)
class Grid:
    """A table of text: the rows of the head, and the labels and cells of each row."""

    head: list[list[Cell]]
    rows: list[tuple[list[Cell], list[Cell]]]


def markdown(text: str) -> str:
    """A text, such as a name from a file, escaped for Markdown and in one line."""
    line = _ENTITY.sub("&amp;", re.sub(r"\s+", " ", printable(text)))
    return _MARKS.sub(r"\\\g<0>", line).replace("<", "&lt;")


def number(value: Any, digits: int = DIGITS) -> str:
    """A value as text: fixed digits, a minus sign, a dash for missing values.

    Very large numbers, and numbers that would be rounded to zero, have two significant digits.
    """
    if value is None or value is pd.NA or value is pd.NaT:
        return NOTHING
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, Integral):
        text = str(int(value))
    elif isinstance(value, Real):
        x = float(value)
        if math.isnan(x):
            return NOTHING
        if math.isinf(x):
            text = "∞" if x > 0 else "-∞"
        elif x and (abs(x) < 0.5 * 10.0**-digits or abs(x) >= _LARGE):
            mantissa, _, power = f"{x:.2g}".partition("e")
            text = f"{mantissa}e{int(power)}" if power else mantissa
        else:
            text = f"{x:.{digits}f}"
    else:
        return str(value)
    return text.replace("-", "−")


def grid(
    frame: pd.DataFrame, *, digits: Mapping[str, int] | int, bold: pd.DataFrame | None
) -> Grid:
    """A data frame as text; its index becomes the labels of the rows.

    An index without a name that only counts the rows is left out.

    Args:
        frame: numbers, strings, or both.
        digits: number of digits after the point, for all columns or by column.
        bold: table of the same shape, True for cells in bold.

    Raises:
        ValueError: ``bold`` has other rows or columns than the frame.
    """
    if bold is not None and not (
        bold.index.equals(frame.index) and bold.columns.equals(frame.columns)
    ):
        raise ValueError("bold must have the rows and columns of the frame")
    labels = _labels(frame)
    columns = []
    for place, name in enumerate(frame.columns):
        wanted = digits if isinstance(digits, int) else digits.get(name, DIGITS)
        values = list(frame.iloc[:, place])
        right = all(_like_number(value) for value in values)
        fat = [False] * len(values) if bold is None else [bool(b) for b in bold.iloc[:, place]]
        columns.append(
            [Cell(number(value, wanted), b, right) for value, b in zip(values, fat, strict=True)]
        )
    label_cells = [[Cell(_label(v)) for v in labels.iloc[:, i]] for i in range(labels.shape[1])]
    rows = [
        ([column[i] for column in label_cells], [column[i] for column in columns])
        for i in range(len(frame))
    ]
    return Grid(_head(frame, list(labels.columns), columns), rows)


def _label(value: Any) -> str:
    """The label of a row, without fixed digits."""
    return f"{value:g}".replace("-", "−") if isinstance(value, float) else number(value)


def _labels(frame: pd.DataFrame) -> pd.DataFrame:
    """The index as columns; levels without a name have an empty one."""
    index = frame.index
    if isinstance(index, pd.RangeIndex) and index.name is None:
        return pd.DataFrame(index=index)
    labels = index.to_frame(index=False)
    labels.columns = pd.Index([str(name) if name is not None else "" for name in index.names])
    return labels


def _head(frame: pd.DataFrame, labels: list[str], columns: list[list[Cell]]) -> list[list[Cell]]:
    """The rows of the head, one per level of the columns; equal neighbours share a cell."""
    depth = frame.columns.nlevels
    names = [name if isinstance(name, tuple) else (name,) for name in frame.columns]
    right = [bool(column) and column[0].right for column in columns]
    head = []
    for level in range(depth):
        last = level == depth - 1
        row = [Cell(label if last else "") for label in labels]
        if last:
            row += [Cell(str(n[level]), right=r) for n, r in zip(names, right, strict=True)]
        else:
            for above, group in groupby(names, key=lambda n: n[: level + 1]):
                row.append(Cell(str(above[-1]), span=len(list(group))))
        head.append(row)
    return head


def _like_number(value: Any) -> bool:
    """Whether a value is aligned to the right: a number, also as text."""
    if isinstance(value, str):
        return value in ("", NOTHING) or _NUMBER.fullmatch(value) is not None
    return value is None or isinstance(value, Real) or value is pd.NA


def csv(frame: pd.DataFrame) -> str:
    """A data frame as CSV with one line of names, in full precision."""
    labels = _labels(frame)
    body = frame.reset_index(drop=True)
    body.columns = pd.Index([column_name(name) for name in frame.columns])
    whole = pd.concat([labels.reset_index(drop=True), body], axis=1)
    return csv_text(whole)


def column_name(name: Any) -> str:
    """The name of a column; the levels of a nested one are joined."""
    if not isinstance(name, tuple):
        return str(name)
    return " ".join(str(part) for part in name if str(part))
