"""Reader of MATLAB files of level 5: numbers, cells and structs, and nothing else.

Written for files that may be damaged: every size is checked against the bytes that are there
before anything is made of it, in plain Python, so that no input ends the process or fills the
memory. ``scipy.io.loadmat`` ends the process with a segmentation fault for some files in which a
single bit is wrong (SciPy 1.17.1).

Source: MathWorks, "MAT-File Format", chapter 1 (level 5).
"""

from __future__ import annotations

import struct
import zlib
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

#: Bytes that a packed file may unpack to.
MOST_BYTES = 1 << 30
#: Cells and structs may contain each other so deep.
_DEEPEST = 8

_MATRIX, _COMPRESSED = 14, 15
_NUMBERS = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
_CELL, _STRUCT, _NUMERIC = 1, 2, range(6, 16)


class Other:
    """A value of a class that is not read: text, objects, sparse or complex matrices."""


def read_matlab(path: Path) -> dict[str, Any]:
    """The variables of a file by name.

    Returns:
        Numeric arrays as NumPy arrays; cell arrays as lists in MATLAB's order of elements;
        structs as dicts, arrays of structs as lists of them; all else as :class:`Other`.

    Raises:
        ValueError: not a file of level 5, a damaged or truncated one, or one that unpacks to
            more than 1 GiB.
        OSError: it cannot be read.
    """
    content = path.read_bytes()
    if len(content) < 128 or content[126:128] not in (b"IM", b"MI"):
        raise ValueError("no header of a MATLAB file of level 5")
    order = "<" if content[126:128] == b"IM" else ">"
    variables: dict[str, Any] = {}
    at, room = 128, MOST_BYTES
    while at < len(content):
        kind, data, at = _element(content, at, order)
        if kind == _COMPRESSED:
            data = _unpacked(data, room)
            room -= len(data)
            kind, data, _ = _element(data, 0, order)
        if kind == _MATRIX:
            name, value = _matrix(data, order, 0)
            variables[name] = value
    return variables


def _unpacked(data: bytes, room: int) -> bytes:
    unpacker = zlib.decompressobj()
    try:
        unpacked = unpacker.decompress(data, room)
    except zlib.error as error:
        raise ValueError(f"a packed variable is damaged: {error}") from error
    if not unpacker.eof:
        raise ValueError(f"a packed variable is truncated, or has more than {room} bytes")
    return unpacked


def _element(data: bytes, at: int, order: str) -> tuple[int, bytes, int]:
    """Type and bytes of the element at ``at``, and where the next one begins."""
    if len(data) - at < 8:
        raise ValueError("it ends within the head of an element")
    kind, size = struct.unpack_from(order + "II", data, at)
    if kind >> 16:  # a small element: size and type share a word, four bytes of data follow
        kind, size, start, after = kind & 0xFFFF, kind >> 16, at + 4, at + 8
        if size > 4:
            raise ValueError(f"a small element says that it has {size} bytes")
    else:
        start = at + 8
        after = start + size + (0 if kind == _COMPRESSED else -size % 8)
    if start + size > len(data):
        raise ValueError(f"an element says {size} bytes, {len(data) - start} are left")
    return kind, data[start : start + size], after


def _numbers(kind: int, data: bytes, order: str) -> np.ndarray:
    if kind not in _NUMBERS:
        raise ValueError(f"numbers of the unknown type {kind}")
    dtype = np.dtype(order + _NUMBERS[kind])
    if len(data) % dtype.itemsize:
        raise ValueError(f"{len(data)} bytes are no whole number of {dtype}")
    return np.frombuffer(data, dtype)


def _matrix(data: bytes, order: str, depth: int) -> tuple[str, Any]:
    """Name and value of a matrix element."""
    if not data:
        return "", np.zeros((0, 0))
    if depth > _DEEPEST:
        raise ValueError(f"cells and structs are nested deeper than {_DEEPEST}")
    kind, flags, at = _element(data, 0, order)
    if len(flags) != 8:
        raise ValueError("an array's flags are missing")
    word = int(_numbers(kind, flags, order)[0]) if kind == 6 else 0
    group, is_complex = word & 0xFF, bool(word & 0x0800)
    kind, sizes, at = _element(data, at, order)
    shape = tuple(int(size) for size in _numbers(kind, sizes, order))
    if len(shape) < 2 or min(shape) < 0:
        raise ValueError(f"an array of shape {shape}")
    _, name, at = _element(data, at, order)
    title = name.decode("latin-1")
    if group == _CELL:
        return title, _each(data, at, order, prod(shape), depth)
    if group == _STRUCT:
        return title, _structs(data, at, order, prod(shape), depth)
    if group not in _NUMERIC or is_complex:
        return title, Other()
    kind, raw, at = _element(data, at, order)
    values = _numbers(kind, raw, order)
    if len(values) != prod(shape):
        raise ValueError(f"an array of shape {shape} has {len(values)} numbers")
    return title, values.reshape(shape, order="F")


def _each(data: bytes, at: int, order: str, number: int, depth: int) -> list[Any]:
    if number > (len(data) - at) // 8:
        raise ValueError(f"{number} elements do not fit into the {len(data) - at} bytes left")
    elements = []
    for _ in range(number):
        kind, part, at = _element(data, at, order)
        if kind != _MATRIX:
            raise ValueError(f"a cell or field of the unknown type {kind}")
        elements.append(_matrix(part, order, depth + 1)[1])
    return elements


def _structs(
    data: bytes, at: int, order: str, number: int, depth: int
) -> dict[str, Any] | list[dict[str, Any]]:
    kind, length, at = _element(data, at, order)
    size = int(_numbers(kind, length, order)[0]) if length else 0
    _, text, at = _element(data, at, order)
    if size < 1 or len(text) % size:
        raise ValueError(f"names of {size} letters in {len(text)} bytes")
    names = [
        text[i : i + size].partition(b"\0")[0].decode("latin-1") for i in range(0, len(text), size)
    ]
    values = _each(data, at, order, number * len(names), depth)
    structs = [
        dict(zip(names, values[i * len(names) : (i + 1) * len(names)], strict=True))
        for i in range(number if names else 0)
    ]
    return structs[0] if len(structs) == 1 else structs
