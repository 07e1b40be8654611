"""Messages for who calls in Python: options as arguments, not as they are typed in a shell."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields

from nnode.data.options import SplitOptions
from nnode.data.prepare import FORMATS
from nnode.errors import NNodeError

#: Names of all options of data.
_NAMES = sorted({one.name for kind in FORMATS for one in fields(kind)}, key=len, reverse=True)
_VALUE = r"(?:=(\[[^\]]*\]|\{[^}]*\}|'[^']*'|\"[^\"]*\"|[^\s,;:)]+))?"
_OPTION = re.compile(rf"(?<![\w./\\-])data\.({'|'.join(_NAMES)})((?:\.\w+)*){_VALUE}")
_GROUP = re.compile(r"(?<![\w./\\-])data=([a-z_]+)\b(?!['\"(])")


@contextmanager
def python_words() -> Iterator[None]:
    """Name options in errors as arguments of :func:`nnode.fit` and its like.

    ``data.faults=keep`` is ``faults='keep'`` there, and ``data.columns.x=pos`` is
    ``columns={'x': 'pos'}``.
    """
    try:
        yield
    except NNodeError as error:
        if error.args and isinstance(error.args[0], str):
            error.args = (as_arguments(error.args[0]), *error.args[1:])
        raise


def as_arguments(text: str) -> str:
    """Words in which options are written as in a shell, with options as arguments."""
    text = _OPTION.sub(_argument, text.replace("no option data.", "no option "))
    return _GROUP.sub(r"data='\1'", text)


def _argument(found: re.Match[str]) -> str:
    name, inner, value = found[1], found[2].strip("."), found[3]
    if (name, inner) == ("split", "heldout"):
        return "heldout" if value is None else f"heldout={value}"
    end = ""
    while value and value[-1] in ".?!":
        value, end = value[:-1], value[-1] + end
    if not inner:
        return name if not value else f"{name}={_literal(value)}{end}"
    if value:
        return f"{name}={{{inner!r}: {_literal(value)}}}{end}"
    return f"{name}[{inner!r}]" if name != "split" or inner in _SPLIT else f"{name}.{inner}"


_SPLIT = {one.name for one in fields(SplitOptions)}


def _literal(value: str) -> str:
    """A value of Hydra's grammar in Python's."""
    words = {"null": "None", "true": "True", "false": "False"}
    plain = re.fullmatch(r"[+-]?\d[\d.]*(?:e[+-]?\d+)?|[A-Z_]+|['\"\[{].*", value)
    return words.get(value, value if plain else repr(value))
