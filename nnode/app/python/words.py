"""Error messages for Python, with options as arguments instead of overrides of a shell."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields

from nnode.data.options import SplitOptions
from nnode.data.prepare import FORMATS
from nnode.errors import NNodeError

#: Names of all options of data.
_NAMES = sorted({option.name for kind in FORMATS for option in fields(kind)}, key=len, reverse=True)
_VALUE = r"(?:=(\[[^\]]*\]|\{[^}]*\}|'[^']*'|\"[^\"]*\"|[^\s,;:)]+))?"
_OPTION = re.compile(rf"(?<![\w./\\-])data\.({'|'.join(_NAMES)})((?:\.\w+)*){_VALUE}")
_GROUP = re.compile(r"(?<![\w./\\-])data=([a-z_]+)\b(?!['\"(])")


@contextmanager
def python_words() -> Iterator[None]:
    """Rewrite options in error messages as arguments of functions such as :func:`nnode.fit`.

    ``data.faults=keep`` becomes ``faults='keep'``, and ``data.columns.x=pos`` becomes
    ``columns={'x': 'pos'}``.
    """
    try:
        yield
    except NNodeError as error:
        if error.args and isinstance(error.args[0], str):
            error.args = (as_arguments(error.args[0]), *error.args[1:])
        raise


def as_arguments(text: str) -> str:
    """A text with overrides of a shell rewritten as arguments."""
    text = _OPTION.sub(_argument, text.replace("no option data.", "no option "))
    return _GROUP.sub(r"data='\1'", text)


def _argument(match: re.Match[str]) -> str:
    name, inner, value = match[1], match[2].strip("."), match[3]
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


_SPLIT = {option.name for option in fields(SplitOptions)}


def _literal(value: str) -> str:
    """A value in Hydra's grammar as a Python literal."""
    words = {"null": "None", "true": "True", "false": "False"}
    plain = re.fullmatch(r"[+-]?\d[\d.]*(?:e[+-]?\d+)?|[A-Z_]+|['\"\[{].*", value)
    return words.get(value, value if plain else repr(value))
