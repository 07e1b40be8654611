"""Strategies of Hypothesis that make malformed files from sound ones."""

from __future__ import annotations

import builtins
import io
import os
import pickle
import re
import subprocess
import warnings
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
import torch
from hypothesis import strategies as st
from hypothesis.strategies import DrawFn, SearchStrategy

#: Pieces that a file is taken apart into: bytes, lines, cells of text, parts of a formula.
BYTES = re.compile(rb"(?s).{1,4}")
LINES = re.compile(rb"[^\n]*\n|[^\n]+")
CELLS = re.compile(rb"[^\s,\[\]{}:<>\"=]+|(?s:.)")
SYMBOLS = re.compile(rb"\w+|(?s:.)")

#: Sizes and offsets of binary formats, and any bytes.
STRANGE_BYTES = st.binary(max_size=64) | st.sampled_from(
    [
        n.to_bytes(4, order)
        for n in (1, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 24)
        for order in ("little", "big")
    ]
)
#: Values that no file of this package holds.
VALUES: SearchStrategy[Any] = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.complex_numbers(),
    st.text(max_size=20),
    st.binary(max_size=20),
    st.sampled_from([10**400, -(2**63), "x" * 5000, "\x1b[31m", "../../x", "2000-01-01", "=1+1"]),
)
STRANGE_CELLS = VALUES.map(lambda value: str(value)[:5000].encode(errors="surrogatepass"))
STRANGE_SYMBOLS = STRANGE_CELLS | st.one_of(
    st.sampled_from(
        ["(", ")", "**", "/", ":=", "=", "@", "lambda", "if", "for", "await", "import"]
    ),
    st.sampled_from(["eval", "__class__", "os.system", "law(gap=gap)", "x_2", "max(", "9**9**9"]),
    st.builds(
        lambda sign, number: sign * number,
        st.sampled_from(["(", ")", "-", "exp("]),
        st.sampled_from([5, 60, 300, 3000]),
    ),
).map(str.encode)


@st.composite
def damaged(
    draw: DrawFn, contents: list[bytes], *kinds: tuple[re.Pattern[bytes], SearchStrategy[bytes]]
) -> bytes:
    """A sound file with one to three times a piece lost, doubled, moved, cut or replaced.

    Args:
        contents: of sound files.
        kinds: of pieces, and what takes their place.
    """
    content = draw(st.sampled_from(contents))
    for _ in range(draw(st.integers(1, 3))):
        pieces, strange = draw(st.sampled_from(kinds))
        parts = pieces.findall(content)
        if not parts:
            break
        places = st.integers(0, len(parts) - 1)
        at = draw(places)
        match draw(st.integers(0, 6)):
            case 0 | 1:
                parts[at] = draw(strange)
            case 2:
                parts.insert(at, draw(strange))
            case 3:
                parts.insert(draw(places), parts[at])
            case 4:
                other = draw(places)
                parts[at], parts[other] = parts[other], parts[at]
            case 5:
                del parts[at]
            case _:
                del parts[at : at + draw(places)]
        content = b"".join(parts)
    return content


def damaged_bytes(*contents: bytes) -> SearchStrategy[bytes]:
    """Malformed files of a binary format."""
    return damaged(list(contents), (BYTES, STRANGE_BYTES))


def damaged_text(*contents: bytes) -> SearchStrategy[bytes]:
    """Malformed files of text."""
    return damaged(list(contents), (CELLS, STRANGE_CELLS), (LINES, STRANGE_CELLS))


def damaged_formula(*formulas: str) -> SearchStrategy[bytes]:
    """Malformed formulas."""
    return damaged([text.encode() for text in formulas], (SYMBOLS, STRANGE_SYMBOLS))


@st.composite
def strange_frame(draw: DrawFn, frames: list[pd.DataFrame]) -> bytes:
    """A pickled data frame with strange cells, types, names, indices or doubled columns."""
    frame = draw(st.sampled_from(frames))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for _ in range(draw(st.integers(1, 3))):
            # pandas itself refuses some of it
            with suppress(TypeError, ValueError, ArithmeticError):
                frame = _changed(draw, frame)
            if not frame.size:
                break
    return pickle.dumps(frame)


def _changed(draw: DrawFn, frame: pd.DataFrame) -> pd.DataFrame:
    """A data frame with one change."""
    frame, place = frame.copy(), draw(st.integers(0, frame.shape[1] - 1))
    values = VALUES | st.sampled_from(
        [pd.NA, pd.NaT, [1], {}, object, np.array([1, 2]), pd.Timestamp("2000-01-01")]
    )
    match draw(st.integers(0, 5)):
        case 0 | 1:
            cells = list(frame.iloc[:, place])
            first = draw(st.integers(0, len(cells) - 1))
            last = draw(st.sampled_from([first + 1, len(cells)]))
            cells[first:last] = [draw(values)] * (last - first)
            frame.isetitem(place, pd.Series(cells, frame.index, dtype=object).array)
        case 2:
            kinds = ["object", "float32", "int8", "uint64", "string", "category", "complex"]
            kinds += ["bool", "Int64", "datetime64[ns]", "timedelta64[s]", "Sparse[float]"]
            kind = draw(st.sampled_from(kinds))
            frame.isetitem(place, frame.iloc[:, place].astype(cast(Any, kind)).array)
        case 3:
            frame = pd.concat([frame, frame.iloc[:, [place]]], axis=1)
        case 4:
            names: list[Any] = list(frame.columns)
            names[place] = draw(VALUES | st.just(("x", "y")))
            frame.columns = pd.Index(names, dtype=object)
        case _:
            changes = [
                lambda: frame.iloc[:0],
                lambda: frame.iloc[:, :0],
                lambda: frame.T,
                lambda: frame[::-1],
                lambda: pd.concat([frame, frame]),
                lambda: frame.set_index(frame.columns[place]),
            ]
            frame = draw(st.sampled_from(changes))()
    return frame


class Calls:
    """Unpickling this calls a function."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return self.call


def gadgets(outside: Path) -> list[Calls]:
    """Objects whose unpickling would write ``outside``, run a program or eat memory."""
    return [
        Calls(os.system, f"touch {outside}"),
        Calls(subprocess.Popen, ["touch", str(outside)]),
        Calls(builtins.exec, f"open({str(outside)!r}, 'w').close()"),
        Calls(builtins.eval, f"open({str(outside)!r}, 'w').close()"),
        Calls(builtins.open, str(outside), "w"),
        Calls(builtins.__import__, "this"),
        Calls(os.mkdir, str(outside)),
        Calls(torch.save, {}, str(outside)),
        Calls(torch.load, str(outside)),
        *(Calls(bytearray, 1 << size) for size in (33, 40, 62)),
        Calls(torch.zeros, 1 << 40),
    ]


@st.composite
def evil_checkpoint(draw: DrawFn, content: bytes, outside: Path) -> bytes:
    """A checkpoint whose pickle calls, or whose archive swells or climbs."""
    gadget = draw(st.sampled_from(gadgets(outside)))
    pickled = pickle.dumps({"config": gadget}, protocol=draw(st.sampled_from((2, 4))))
    kind = draw(st.integers(0, 5))
    if kind == 0:
        return pickled
    made = io.BytesIO()
    if kind == 1:
        torch.save({**_opened(content), "config": gadget}, made)
        return made.getvalue()
    packing = zipfile.ZIP_DEFLATED if kind == 2 else zipfile.ZIP_STORED
    up = draw(st.sampled_from(("../" * 6, "/", "..\\" * 4))) + outside.name
    with (
        zipfile.ZipFile(io.BytesIO(content)) as before,
        zipfile.ZipFile(made, "w", packing) as file,
    ):
        for name in before.namelist():
            data = before.read(name)
            if name.endswith("data.pkl"):
                if kind == 2:  # zeros, a thousand times smaller when packed
                    data += bytes(draw(st.sampled_from((1 << 16, 1 << 20, 1 << 22))))
                elif kind == 3:
                    data = draw(damaged_bytes(data))
                elif kind == 4:
                    data = pickled
            file.writestr(f"{up}/{name}" if kind == 5 else name, data)
    return made.getvalue()


@st.composite
def strange_checkpoint(draw: DrawFn, content: bytes) -> bytes:
    """A checkpoint that opens, with one to three of its values lost or replaced by strange ones."""
    whole = _opened(content)
    tensors = [
        torch.zeros(0),
        torch.full((2, 2), float("nan")),
        torch.zeros(1).expand(10**6),
        torch.tensor(1j),
    ]
    values = VALUES | st.sampled_from([*tensors, [], {}, {"a": 1}, [None]])
    for _ in range(draw(st.integers(1, 3))):
        place: Any = whole
        while place:
            key = draw(
                st.sampled_from(list(place) if isinstance(place, dict) else range(len(place)))
            )
            if isinstance(place[key], dict | list) and place[key] and draw(st.integers(0, 4)):
                place = place[key]
                continue
            if draw(st.integers(0, 4)):
                place[key] = draw(values)
            else:
                del place[key]
            break
    made = io.BytesIO()
    torch.save(whole, made)
    return made.getvalue()


def _opened(content: bytes) -> Any:
    return torch.load(io.BytesIO(content), weights_only=True)
