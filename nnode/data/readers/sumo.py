"""Reader of SUMO's floating car data: XML with one element per time and vehicle.

The file is streamed: only numbers are kept, never its text. Documents with a type declaration
are refused, so that no entity is ever expanded.
"""

from __future__ import annotations

import gzip
import math
import sys
import zlib
from array import array
from dataclasses import dataclass
from pathlib import Path
from typing import IO, cast
from xml.parsers import expat

import numpy as np

from nnode.data.cut import LaneOptions, Reading, by_lane, check_cutting
from nnode.data.readers.recordings import table_path
from nnode.data.trajectories import Trajectories
from nnode.errors import ConfigError, DataError

#: Lanes within a junction have names that begin with this sign.
INTERNAL = ":"


@dataclass
class SumoOptions(LaneOptions):
    """SUMO's floating car data (fcd-output, XML, also gzipped)."""

    name: str = "sumo"


def sumo_files(options: SumoOptions) -> dict[str, Path]:
    """The file's path."""
    path = table_path(options)
    return {_stem(path): path}


def read_sumo(path: Path, options: SumoOptions) -> Reading:
    """Read a file of ``sumo --fcd-output`` and cut it as a vehicle table.

    A vehicle's position is ``pos``, along its ``lane``; positions begin anew on every edge, so
    that a stay ends where a vehicle leaves it. Lanes within junctions are left out unless
    ``data.lane`` names them. ``type`` becomes the class, ``length`` the length where SUMO was
    asked for it; people and containers are not read.

    Args:
        path: XML, also gzipped.
        options: lanes, time grid and the way of cutting.

    Returns:
        Sequences named ``recording/number``, recording being the file's name and the lane.

    Raises:
        ConfigError: an option out of its range, or ``data.dt`` finer than the file's steps.
        DataError: no such XML (names the line), one vehicle twice at one time, or no sequence.
    """
    path = Path(path)
    check_cutting(options)
    content = _Content(path)
    content.read()
    rows = content.rows(within=options.lane is not None)
    if rows.dt > options.dt * (1 + 1e-6):
        raise ConfigError(
            f"data.dt={options.dt:g} s is finer than the steps of {path}, {rows.dt:g} s; set "
            f"data.dt={rows.dt:g}, or let SUMO write with --step-length {options.dt:g}"
        )
    return by_lane(rows, options, lane_word="")


def _stem(path: Path) -> str:
    name = path.name
    for ending in (".gz", ".xml"):
        name = name.removesuffix(ending)
    return name


class _Content:
    """What the elements of a file hold."""

    def __init__(self, path: Path) -> None:
        self.path = path
        # of interned names each text is kept once
        self.names: dict[str, list[str]] = {"id": [], "lane": [], "type": []}
        self.numbers = {key: array("d") for key in ("time", "pos", "speed", "length", "line")}
        self.now: float | None = None
        self.root: str | None = None
        self.parser = expat.ParserCreate()
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.StartDoctypeDeclHandler = self._doctype

    def read(self) -> None:
        """Read the file through.

        Raises:
            DataError: it is not what SUMO writes; names the line.
        """
        try:
            with _open(self.path) as file:
                self.parser.ParseFile(file)
        except expat.ExpatError as error:
            raise DataError(
                f"{self.path}, line {error.lineno}: no whole XML document "
                f"({expat.ErrorString(error.code)}); the simulation may still have been writing it"
            ) from error
        except (LookupError, ValueError) as error:  # an encoding that is unknown or of many bytes
            raise DataError(
                f"{self.path}, line {self.parser.CurrentLineNumber}: {error}; write it in UTF-8"
            ) from error
        except (OSError, EOFError, zlib.error) as error:
            raise DataError(f"{self.path} cannot be read: {error}") from error
        if not self.names["id"]:
            raise DataError(
                f"{self.path} holds no vehicle; expected <vehicle> within <timestep>, as "
                "sumo --fcd-output writes them"
            )

    def rows(self, within: bool) -> Trajectories:
        """The vehicles; those on lanes of junctions only where they are asked for.

        Raises:
            DataError: nobody is left.
        """
        names = {key: np.array(cells, dtype=object) for key, cells in self.names.items()}
        keep = np.array([within or not name.startswith(INTERNAL) for name in names["lane"]])
        if not keep.any():
            raise DataError(
                f"{self.path}: all vehicles are on lanes within junctions, which are left out; "
                "name those to read in data.lane"
            )
        agent, lane, kind = (cells[keep] for cells in names.values())
        time, x, speed, length, line = (np.asarray(c)[keep] for c in self.numbers.values())
        return Trajectories(
            path=self.path,
            name=_stem(self.path),
            where=lambda i: f"line {line[i]:.0f}",
            agent=agent,
            time=time,
            x=x[:, None],
            lane=lane,
            v=None if np.isnan(speed).any() else np.abs(speed)[:, None],
            length=None if np.isnan(length).all() else length,
            kind=kind if (kind != "").any() else None,
        )

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        if self.root is None:
            self.root = name
            if name != "fcd-export":
                raise self._error(f"expected the root element <fcd-export>, found <{name}>")
        elif name == "timestep":
            self.now = self._number(name, attributes, "time")
        elif name == "vehicle":
            if self.now is None:
                raise self._error("a <vehicle> stands outside <timestep>")
            for key, names in self.names.items():
                if not attributes.get(key) and key != "type":
                    raise self._error(
                        f"a <vehicle> has no attribute {key!r}; expected id, pos and lane: leave "
                        "--fcd-output.attributes out, or name them there"
                    )
                names.append(sys.intern(attributes.get(key, "")))
            self.numbers["time"].append(self.now)
            for key in ("pos", "speed", "length"):
                given = key in attributes or key == "pos"
                value = self._number(name, attributes, key) if given else math.nan
                self.numbers[key].append(value)
            self.numbers["line"].append(self.parser.CurrentLineNumber)

    def _end(self, name: str) -> None:
        if name == "timestep":
            self.now = None

    def _doctype(self, *_: object) -> None:
        raise self._error(
            "a document type declaration, which SUMO never writes and nothing here expands; "
            "remove it"
        )

    def _number(self, name: str, attributes: dict[str, str], key: str) -> float:
        text = attributes.get(key)
        try:
            value = math.nan if text is None else float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            shown = "no such attribute" if text is None else repr(text[:40])
            hint = (
                "; write times in seconds, without --human-readable-time" if key == "time" else ""
            )
            raise self._error(f"<{name} {key}=...>: expected a number, found {shown}{hint}")
        return value

    def _error(self, text: str) -> DataError:
        return DataError(f"{self.path}, line {self.parser.CurrentLineNumber}: {text}")


def _open(path: Path) -> IO[bytes]:
    with path.open("rb") as file:
        packed = file.read(2) == b"\x1f\x8b"
    return cast(IO[bytes], gzip.open(path, "rb") if packed else path.open("rb"))
