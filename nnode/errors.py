"""The exceptions of the package, which are all derived from :class:`NNodeError`.

Every message states what was expected, what was found, where (file, row, option) and what to do.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from typing import Any

#: Largest number of characters of a message.
LONGEST = 2000

#: Characters that a terminal interprets or does not show: control characters other than line feed
#: and tab, marks of the writing direction and of zero width, line separators, and surrogates.
_CONTROL = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\xad\u061c\u180e\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff"
    "\ufff9-\ufffb\ud800-\udfff\U000e0000-\U000e007f]"
)

_DATA_OPTION = re.compile(r"\bdata(=|\.\w)")
#: Note of an error that names an option of data.
IN_PYTHON = (
    "In Python, options of data are arguments without the prefix: data.faults=keep is "
    "faults='keep', data.columns.x=pos is columns={'x': 'pos'}, data.split.heldout=0 is heldout=0."
)


def printable(text: str, limit: int = LONGEST) -> str:
    """A text with parts of files, in a form that is safe to show.

    Control characters become escapes, such as ``\\x1b``. A longer text is cut in the middle,
    because a message begins with the place of an error and ends with what to do.
    """
    shown = _CONTROL.sub(lambda match: match.group().encode("unicode_escape").decode(), text)
    if len(shown) <= limit:
        return shown
    note = f" [... {len(shown)} characters in all ...] "
    kept = limit - len(note)
    return shown[: kept - kept // 3] + note + shown[len(shown) - kept // 3 :]


def suggestion(word: str, words: Iterable[str] | Mapping[str, str], cutoff: float = 0.6) -> str:
    """The end of a message that suggests the most similar word, ignoring case; empty for none.

    Args:
        words: the words, or word to the text that suggests it.
        cutoff: smallest similarity, see :func:`difflib.get_close_matches`.
    """
    texts = words if isinstance(words, Mapping) else {name: name for name in words}
    folded = {name.casefold(): text for name, text in texts.items()}
    near = get_close_matches(word.casefold(), list(folded), n=1, cutoff=cutoff)
    return f"; did you mean {folded[near[0]]}?" if near else ""


def unknown_value(
    option: str, value: object, choices: Iterable[str], hint: str = ""
) -> ConfigError:
    """The error for a value that is none of an option's choices, with the most similar one.

    Args:
        hint: text after the list of choices.
    """
    names = list(choices)
    return ConfigError(
        f"{option}={value} is unknown, expected one of {', '.join(names)}{hint}"
        f"{suggestion(str(value), names)}"
    )


class NNodeError(Exception):
    """Base class of all errors of the package.

    Messages may quote cells, names of columns and other parts of files, so they are made printable
    and have at most :data:`LONGEST` characters. They name options of data as on the command line; a
    note, which only a traceback shows, explains how Python takes them.
    """

    def __init__(self, *args: Any) -> None:
        super().__init__(*(printable(a) if isinstance(a, str) else a for a in args))
        if _DATA_OPTION.search(str(self)):
            self.add_note(IN_PYTHON)


class DataError(NNodeError):
    """The content of a file or table does not agree with its format."""


class FaultError(DataError):
    """Measured sequences have faults, and ``data.faults`` is ``error``."""


class DownloadError(DataError):
    """Public data could not be downloaded, or differ from the published data."""


class ConfigError(NNodeError):
    """An option is unknown, of the wrong type, or contradicts another one."""


class SimulationError(NNodeError):
    """A simulation has values that are not finite or not meaningful."""


class CheckpointError(NNodeError):
    """A checkpoint is missing, damaged or of another format."""


class StudyError(NNodeError):
    """Tasks of a study failed, or its workers cannot run; finished tasks are kept."""


class WriteError(NNodeError):
    """A file cannot be written, for example on a full disk; earlier files are kept."""


class FolderInUseError(NNodeError):
    """Another run uses the folder."""


class NotFittedError(NNodeError, ValueError, AttributeError):
    """An estimator has not been fitted yet."""
