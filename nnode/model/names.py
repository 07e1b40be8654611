"""Checks of names in formulas, which become names in generated source."""

from __future__ import annotations

import keyword
import re
from collections.abc import Iterable

from nnode.errors import ConfigError

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9]*(?:_[A-Za-z0-9]+)*")
#: A symbol consists of an owner's name, a name and numbers.
_SYMBOL = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
#: Largest number of entries of a kind, such as ``where``. The package's laws have at most 30. A
#: law with 100 entries of each kind is built or refused within seconds.
ENTRIES = 100
#: Largest number of characters of a name in an error message.
_SHOWN = 80


def check_names(what: str, names: Iterable[object], *, in_code: bool = False) -> None:
    """Check that formulas and generated source can contain names.

    Args:
        what: the kind of the names, for the error message.
        in_code: whether the names are Python attributes. A name such as ``lambda_`` may then end
            with an underscore, because it would be a keyword without it.

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
    """Check the symbols of a generated module.

    Names are also checked where they enter a model. This second check comes directly before the
    source is generated.

    Raises:
        ConfigError: a name that is not a valid symbol.
    """
    for name in names:
        if not _SYMBOL.fullmatch(name) or keyword.iskeyword(name):
            raise ConfigError(
                f"no source is generated with the name {name[:_SHOWN]!r}: it is no symbol of a "
                "formula"
            )
