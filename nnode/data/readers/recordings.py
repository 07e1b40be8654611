"""Which recordings of a data source are asked for, and which files hold them."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from nnode.data import download
from nnode.data.options import DataOptions, chosen
from nnode.errors import ConfigError, DataError, NNodeError

#: What Python and its libraries raise for contents that no reader expects.
FOREIGN = (
    ArithmeticError,
    AttributeError,
    LookupError,
    MemoryError,
    RecursionError,
    TypeError,
    ValueError,
)


@contextmanager
def reading(what: object) -> Iterator[None]:
    """Errors of Python and its libraries become the package's own.

    The readers have their own words for what they know to be wrong. This is for the rest.

    Args:
        what: is read; for the message.

    Raises:
        DataError: with the name and the text of the other error.
    """
    try:
        yield
    except NNodeError:
        raise
    except FOREIGN as error:
        raise DataError(
            f"{what} cannot be read ({type(error).__name__}: {error}); it holds something that no "
            "reader expects: look for cells that are no numbers, names or times"
        ) from error


def natural(name: str) -> tuple[list[tuple[int, str]], str]:
    """A key that sorts names as they are counted: ``s2`` before ``s10``."""
    parts = re.split(r"(\d+)", name)
    parts[1::2] = [digits.lstrip("0") for digits in parts[1::2]]
    # a number of more digits is larger
    return [(len(p) if i % 2 else 0, p) for i, p in enumerate(parts)], name


def raw_files(
    options: DataOptions,
    *,
    default: str,
    pattern: re.Pattern[str],
    file_name: Callable[[str], str],
) -> dict[str, Path]:
    """Locate the raw files of a public format, by recording.

    Args:
        options: ``name``, ``source``, ``download`` and ``recording`` are read.
        default: the published data set to which a source of another name belongs.
        pattern: matches a file name of the format; group 1 is the recording.
        file_name: the file name of a recording.

    Returns:
        The path of each recording's file. "all" are the published recordings, or, in a local
        folder that holds none of them, every file whose name matches.

    Raises:
        ConfigError: an unknown recording.
        DataError, DownloadError: see :func:`nnode.data.download.locate`.
    """
    dataset = options.name if options.name in download.FILES else default
    public = _matches(pattern, download.FILES[dataset])
    source = options.source or os.environ.get(download.FOLDER_VARIABLE) or ""
    folder = None if "://" in source or not source else Path(source).expanduser()
    local = _matches(pattern, [] if folder is None else sorted(download.held(folder, dataset)))
    every = public if set(public) & set(local) or not local else local
    asked = chosen(options.recording, [*public, *local], every)
    files = download.locate(
        dataset,
        [file_name(name) for name in asked],
        source=options.source,
        folder=Path(options.download or "raw"),
    )
    return dict(zip(asked, files.values(), strict=True))


def table_path(options: DataOptions, option: str = "path") -> Path:
    """The path of a user's table: as an option gives it, or else below ``data.source``.

    Raises:
        ConfigError: the path is not set, or ``data.source`` is an address.
        DataError: there is no such file.
    """
    place = place_below(options, option)
    if not place.is_file():
        raise DataError(
            f"data.{option}: {place} is a folder, expected a file; set data.{option} to a table of "
            "your own"
        )
    return place


def place_below(options: DataOptions, option: str = "path") -> Path:
    """A file or a folder: as an option gives it, or else below ``data.source``.

    Raises:
        ConfigError: no path, or ``data.source`` is an address.
        DataError: there is no such thing.
    """
    path = getattr(options, option)
    if not path or path == "???":
        raise ConfigError(f"data.{option} is not set; expected the path of a table")
    place = Path(path).expanduser()
    if options.source is not None and not place.is_absolute() and not place.exists():
        if "://" in options.source:
            raise ConfigError(
                f"data.source={options.source}: tables are read from a folder; download the "
                "table and set data.source to its folder"
            )
        place = Path(options.source).expanduser() / place
    if not place.exists():
        raise DataError(
            f"data.{option}: {place} is not there; set data.{option} to a table of your own, "
            f"tables are not downloaded{_published(options.name)}"
        )
    return place


def tables_below(options: DataOptions, patterns: Iterable[str]) -> dict[str, Path]:
    """A file, or the files of a folder, by their path below it; a single file by its name.

    Args:
        options: ``name``, ``source`` and ``path`` are read.
        patterns: of the files of a folder, of which the first that fits any is taken.

    Raises:
        ConfigError, DataError: see :func:`place_below`; or a folder without such a file.
    """
    place = place_below(options)
    if place.is_file():
        return {place.name: place}
    for pattern in patterns:
        files = sorted(path for path in place.glob(pattern) if path.is_file())
        if files:
            return {path.relative_to(place).as_posix(): path for path in files}
    raise DataError(
        f"data.path: the folder {place} holds no file like {' or '.join(patterns)} (data.files)"
        f"{_published(options.name)}"
    )


def _published(name: str) -> str:
    """Where a data set is published whose files have no addresses of their own."""
    origin = download.ORIGINS.get(name)
    if origin is None:
        return ""
    return (
        f"; those of {name} lie in {origin.path}/ of github.com/{origin.repository} at commit "
        f"{origin.commit}: fetch that, and set data.path to the folder"
    )


def _matches(pattern: re.Pattern[str], names: Iterable[str]) -> list[str]:
    matches = (pattern.fullmatch(name) for name in names)
    return [match.group(1) for match in matches if match]
