"""The options that read a table of anybody's: what its columns mean and in which units they are.

The same recognition as that of the check, without a look at faults.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from nnode.data.check.columns import Meaning, in_seconds, meanings, plain, rivals
from nnode.data.check.examine import sure
from nnode.data.check.raw import Raw, read_raw
from nnode.data.check.rows import Scaled, scaled
from nnode.data.check.scale import SURE, Scale
from nnode.data.check.source import (
    CALLED,
    Recognised,
    native_source,
    source_of,
    source_of_native,
)
from nnode.data.options import DataOptions, PairOptions, TableOptions, VehicleTableOptions
from nnode.data.readers import pairs, table, vehicles
from nnode.data.readers.columns import Table
from nnode.data.sequence import Domain
from nnode.errors import ConfigError, DataError, NNodeError

#: Formats of tables, by the group of their options, each with columns that it cannot do without.
NEEDED: dict[str, tuple[type[DataOptions], set[str]]] = {
    "pairs": (PairOptions, set(pairs.REQUIRED)),
    "table": (TableOptions, set(table.REQUIRED)),
    "vehicles": (VehicleTableOptions, set(vehicles.REQUIRED)),
}
#: Columns of pairs whose positions are integrated.
SPACED = {"time", *pairs.INTEGRATED}
#: Options that say units, by the quantity.
UNIT = {"position": "position_unit", "time": "time_unit", "speed": "speed_unit"}


def recognised(
    source: pd.DataFrame | str | Path,
    domain: Domain | None = None,
    given: Mapping[str, Any] | None = None,
) -> Recognised:
    """How a table is read: what the user says of it, and what its names and numbers show.

    A table with all columns of a format, ``sequence, time, agent, x`` or ``vehicle, time, x`` or
    ``time, x_follower, x_leader``, is of that format and in SI units, unless its numbers surely
    are of other units; a tidy table keeps SI units even then, and the line says so.

    Args:
        source: a data frame, or the path of a table or of a file of a known format.
        domain: of the data; None: as the columns show.
        given: options that are known already, ``columns``, units and ``frame_rate``: they win.

    Raises:
        ConfigError: no such file; columns or units that may be two things; names both.
        DataError: no table of trajectories; names what is lacking.
    """
    if domain not in (None, "traffic", "crowd"):
        raise ConfigError(f"data.domain={domain}: expected traffic or crowd")
    raw, memory = _raw(source), isinstance(source, pd.DataFrame)
    if raw.table is None:
        return _native(raw)
    found = _of_table(in_seconds(raw), memory, domain, dict(given or {}))
    if not memory:
        return found
    return replace(
        found,
        options=replace(found.options, path=""),  # type: ignore[call-arg]
        table=raw.table,
    )


def _raw(source: pd.DataFrame | str | Path) -> Raw:
    if isinstance(source, pd.DataFrame):
        return Raw(Path("table"), table=Table(source), separator="")
    return read_raw(Path(source).expanduser())


def _of_table(
    raw: Raw, memory: bool, domain: Domain | None, given: Mapping[str, Any]
) -> Recognised:
    """How columns are read; ``memory`` says that the table comes from no file."""
    exact = _exact(raw, given)
    if exact == "table":
        return _tidy(raw, domain, given)
    found = _with_given(raw, meanings(raw), given)
    if exact is None and not memory and (native := native_source(raw, found)) is not None:
        return _native(replace(raw, native=native))
    unclear = rivals(found) if exact is None else {}
    for meaning in ("agent", "time", "frame", "x", "y", "sequence", "lane"):
        if meaning in unclear:
            raise ConfigError(f"{raw.path}: {unclear[meaning]}")
    rate = given.get("frame_rate")
    told = {what: str(given[key]) for what, key in UNIT.items() if key in given}
    try:
        seen = scaled(raw, found, domain, rate, told)
    except DataError:
        if exact is None:
            raise
        return _by_name(raw, exact, given)
    if exact is None:
        _check_units(raw, seen, rate or raw.rate, told)
    elif told or _si(seen.scale) or seen.share < SURE:
        return _by_name(raw, exact, given)
    found = seen.meanings
    read = source_of(raw, seen)
    return replace(read, line=_line(raw, found, seen, read.group))


def _native(raw: Raw) -> Recognised:
    """A file of a format whose reader knows its columns and units."""
    read = source_of_native(raw)
    return replace(read, line=f"{raw.path}: read as data={read.group}")


def _by_name(raw: Raw, group: str, given: Mapping[str, Any]) -> Recognised:
    """A table with the columns of a format, in the units that the format has by default."""
    columns = dict(given.get("columns") or {})
    return Recognised(group, NEEDED[group][0](path=str(raw.path), columns=columns))  # type: ignore[call-arg]


def has_columns(source: pd.DataFrame | str | Path, group: str, given: Mapping[str, Any]) -> bool:
    """Whether a table has the columns of a format, under their own names or those given.

    What is no table, or no file, has them: its reader says what is wrong.
    """
    try:
        raw = _raw(source)
    except NNodeError:
        return True
    return raw.table is None or _fits(group, _names(raw, given))


def _names(raw: Raw, given: Mapping[str, Any]) -> set[str]:
    """Columns under their own names, and the meanings of those that are given."""
    assert raw.table is not None
    return set(map(str, raw.table.frame.columns)) | set(given.get("columns") or {})


def _fits(group: str, names: set[str]) -> bool:
    return names >= NEEDED[group][1] or (group == "pairs" and names >= SPACED)


def _exact(raw: Raw, given: Mapping[str, Any]) -> str | None:
    """The format whose columns a table has under their own names, or under those given."""
    names = _names(raw, given)
    if names >= SPACED and not names & {"x", "x_follower", "x_leader"}:
        return "pairs"
    if "vehicle" in names and "sequence" not in names and "x_follower" not in names:
        return "vehicles" if names >= NEEDED["vehicles"][1] else None
    return next((group for group, (_, needed) in NEEDED.items() if names >= needed), None)


def _tidy(raw: Raw, domain: Domain | None, given: Mapping[str, Any]) -> Recognised:
    """A tidy table: its units are those that are documented, or given."""
    names = _names(raw, given)
    chosen: Domain = domain or ("crowd" if "y" in names else "traffic")
    read, line = _by_name(raw, "table", given), ""
    if not any(key in given for key in UNIT.values()):
        try:
            seen = scaled(raw, _with_given(raw, meanings(raw), given), chosen, None)
        except (DataError, ConfigError):
            return replace(read, options=replace(read.options, domain=chosen))
        best = seen.scale
        if not _si(best) and seen.share >= SURE:
            line = (
                f"{raw.path}: a tidy table is read in m and s, and its numbers look like "
                f"{best}; {best.options} reads it so"
            )
    return replace(read, options=replace(read.options, domain=chosen), line=line)


def _with_given(
    raw: Raw, found: dict[str, Meaning], given: Mapping[str, Any]
) -> dict[str, Meaning]:
    """Meanings as the user says, and the others as they were recognised."""
    assert raw.table is not None
    names = list(map(str, raw.table.frame.columns))
    columns: Mapping[str, str | None] = given.get("columns") or {}
    own: dict[str, Meaning] = {}
    for key, column in columns.items():
        meaning = CALLED.get(str(key), str(key))
        if column is None:
            found = {m: one for m, one in found.items() if m != meaning}
            continue
        if column not in names:
            raise ConfigError(
                f"data.columns.{key}={column}: {raw.path} has no such column, it has "
                f"{', '.join(names)}"
            )
        if meaning == "time" and given.get("time_unit") == "frame":
            meaning = "frame"
        own[meaning] = Meaning(column, plain(column)[1], "given")
    taken = {one.column for one in own.values()}
    if {"time", "frame"} & own.keys():
        found = {m: one for m, one in found.items() if m not in ("time", "frame")}
    return {m: one for m, one in found.items() if one.column not in taken} | own


def _check_units(raw: Raw, seen: Scaled, rate: float | None, told: Mapping[str, str]) -> None:
    """Refuse units, or rates of frames, that may be two things.

    Raises:
        ConfigError: names both.
    """
    doubts = seen.doubts(rate)
    if "units" in doubts and not told:
        raise ConfigError(f"{raw.path}: {doubts['units']}")
    if len(seen.rates(rate)) > 1:
        raise ConfigError(f"{raw.path}: {doubts['rate']}")


def _si(scale: Scale) -> bool:
    return (scale.position, scale.time, scale.rate, scale.speed) == ("m", "s", None, "m/s")


def _line(raw: Raw, found: Mapping[str, Meaning], seen: Scaled, group: str) -> str:
    named = ", ".join(f"{meaning} = {one.column}" for meaning, one in found.items())
    words, scale = f"{seen.scale} ({sure(seen.share)})", seen.scale
    if scale.rate is not None and raw.rate not in (None, scale.rate):
        words = f"{replace(scale, rate=raw.rate)} as it tells; {scale.rate:g} frames/s fit"
    return f"{raw.path}: recognised {named}; {words}; read as data={group}"
