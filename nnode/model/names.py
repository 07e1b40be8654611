"""Names in formulas. They become names in generated source, so none is taken unchecked."""

from __future__ import annotations

import keyword
import re
from collections.abc import Iterable

from nnode.errors import ConfigError

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9]*(?:_[A-Za-z0-9]+)*")
#: Symbols are made of names, of their owners' names, and of numbers.
_SYMBOL = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
#: Most entries of a kind, such as ``where``: the package's laws have 30 at most. A law with 100
#: of each kind is built, or refused, within seconds.
ENTRIES = 100
#: Characters of a name that an error shows.
_SHOWN = 80


def check_names(what: str, names: Iterable[object], *, in_code: bool = False) -> None:
    """Check that names can stand in formulas and in generated source.

    Args:
        what: the kind of the names, for the error.
        in_code: whether they stand in Python code, where a name such as ``lambda_`` ends with an
            underscore because it would be a keyword without it.

    Raises:
        ConfigError: too many names, a name with other characters, or a keyword of Python.
    """
    names = list(names)
    if len(names) > ENTRIES:
        raise ConfigError(f"{what}: {len(names)} entries, expected at most {ENTRIES}")
    for name in names:
        text = name if isinstance(name, str) and not keyword.iskeyword(name) else ""
        if not _NAME.fullmatch(text.removesuffix("_") if in_code else text):
            raise ConfigError(
                f"{what}: {str(name)[:_SHOWN]!r} cannot be a name; expected ASCII letters, "
                "digits and single underscores between them, beginning with a letter, and no "
                "keyword of Python, as v0 or time_gap"
            )


def check_symbols(names: Iterable[str]) -> None:
    """Check the names that a generated module is about to contain.

    Names are checked where they enter a model; this is the second check, directly before they
    become source.

    Raises:
        ConfigError: a name that is no symbol.
    """
    for name in names:
        if not _SYMBOL.fullmatch(name) or keyword.iskeyword(name):
            raise ConfigError(
                f"no source is generated with the name {name[:_SHOWN]!r}: it is no symbol of a "
                "formula"
            )
