"""The options that read a table of anybody's: what its columns mean and in which units they are.

The same recognition as that of the check, without a look at faults.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from nnode.data.check.columns import (
    NAMES,
    Meaning,
    are_pairs,
    clock_of,
    in_seconds,
    is_spaced,
    meanings,
    plain,
    rivals,
)
from nnode.data.check.raw import Raw, read_raw
from nnode.data.check.rows import Scaled, scaled
from nnode.data.options import Agents, DataOptions
from nnode.data.readers import jupedsim, pairs, table, vehicles
from nnode.data.readers.columns import Table
from nnode.data.readers.esimas import EsimasOptions
from nnode.data.readers.highd import TRACKS, HighDOptions
from nnode.data.readers.jupedsim import WalkwayOptions
from nnode.data.readers.ngsim import NgsimOptions
from nnode.data.readers.openacc import OpenAccOptions
from nnode.data.readers.pairs import PairOptions
from nnode.data.readers.sumo import SumoOptions
from nnode.data.readers.table import TableOptions
from nnode.data.readers.vehicles import VehicleTableOptions
from nnode.data.sequence import Domain
from nnode.data.trajectories import Trajectories
from nnode.data.units import SURE, Scale, certainty
from nnode.errors import ConfigError, DataError, NNodeError

_NGSIM = {"Vehicle_ID", "Frame_ID", "Global_Time", "Local_Y", "Lane_ID"}

_RUNS = {"run", "position", "t", "v", "gap"}

#: Meanings that readers call by another name.
CALLED = {"vehicle": "agent", "run": "recording"}
#: Options and readers of tables by the group.
_TABLES: dict[str, tuple[type[DataOptions], Any]] = {
    "pairs": (PairOptions, pairs),
    "table": (TableOptions, table),
    "vehicles": (VehicleTableOptions, vehicles),
    "pedpy": (WalkwayOptions, jupedsim),
}
#: Formats of tables, by the group of their options, each with columns that it cannot do without.
NEEDED = {
    group: (kind, set(reader.REQUIRED))
    for group, (kind, reader) in _TABLES.items()
    if group != "pedpy"
}
#: Columns of pairs whose positions are integrated.
SPACED = {"time", *pairs.INTEGRATED}
#: Options that say units, by the quantity.
UNIT = {"position": "position_unit", "time": "time_unit", "speed": "speed_unit"}


@dataclass(frozen=True)
class Recognised:
    """How a file or a table is read.

    Attributes:
        group: name of the data source, as in ``conf/data``.
        options: that read it.
        table: what they read; None: the file that they name.
        line: what was recognised, in words; empty where names and units are those of the format.
    """

    group: str
    options: DataOptions
    table: Table | None = None
    line: str = ""


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
    source_of_table = _of_table(in_seconds(raw), memory, domain, dict(given or {}))
    if not memory:
        return source_of_table
    return replace(
        source_of_table,
        options=replace(source_of_table.options, path=""),  # type: ignore[call-arg]
        table=raw.table,
    )


def _raw(source: pd.DataFrame | str | Path) -> Raw:
    if isinstance(source, pd.DataFrame):
        return Raw(Path("table"), table=Table(source))
    return read_raw(Path(source).expanduser())


def _of_table(
    raw: Raw, memory: bool, domain: Domain | None, given: Mapping[str, Any]
) -> Recognised:
    """How columns are read; ``memory`` says that the table comes from no file."""
    exact = _exact(raw, given)
    if exact == "table":
        return _tidy(raw, domain, given)
    columns = _with_given(raw, meanings(raw), given)
    if exact is None and not memory and (native := native_source(raw, columns)) is not None:
        return _native(replace(raw, native=native))
    unclear = rivals(columns) if exact is None else {}
    for meaning in ("agent", "time", "frame", "x", "y", "sequence", "lane"):
        if meaning in unclear:
            raise ConfigError(f"{raw.path}: {unclear[meaning]}")
    rate = given.get("frame_rate")
    stated = {what: str(given[key]) for what, key in UNIT.items() if key in given}
    try:
        measured = scaled(raw, columns, domain, rate, stated)
    except DataError:
        if exact is None:
            raise
        return _by_name(raw, exact, given)
    if exact is None:
        _check_units(raw, measured, rate or raw.rate, stated)
    elif stated or _si(measured.scale) or measured.share < SURE:
        return _by_name(raw, exact, given)
    columns = measured.meanings
    read = source_of(raw, measured)
    return replace(read, line=_line(raw, columns, measured, read.group))


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
    if raw.table is None:
        return True
    names = _names(raw, given)
    return names >= NEEDED[group][1] or (group == "pairs" and names >= SPACED)


def _names(raw: Raw, given: Mapping[str, Any]) -> set[str]:
    """Columns under their own names, and the meanings of those that are given."""
    return set(map(str, raw.frame.columns)) | set(given.get("columns") or {})


def _exact(raw: Raw, given: Mapping[str, Any]) -> str | None:
    """The format whose columns a table has under their own names, or under those given."""
    names = _names(raw, given)
    if "time" in names and is_spaced(names):
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
            measured = scaled(raw, _with_given(raw, meanings(raw), given), chosen, None)
        except (DataError, ConfigError):
            return replace(read, options=replace(read.options, domain=chosen))
        best = measured.scale
        if not _si(best) and measured.share >= SURE:
            line = (
                f"{raw.path}: a tidy table is read in m and s, and its numbers look like "
                f"{best}; {best.options} reads it so"
            )
    return replace(read, options=replace(read.options, domain=chosen), line=line)


def _with_given(
    raw: Raw, recognised_columns: dict[str, Meaning], given: Mapping[str, Any]
) -> dict[str, Meaning]:
    """Meanings as the user says, and the others as they were recognised."""
    names = list(map(str, raw.frame.columns))
    columns: Mapping[str, str | None] = given.get("columns") or {}
    given_columns: dict[str, Meaning] = {}
    left_out = set()
    for key, column in columns.items():
        meaning = CALLED.get(str(key), str(key))
        if column is None:
            left_out.add(meaning)
            continue
        if column not in names:
            raise ConfigError(
                f"data.columns.{key}={column}: {raw.path} has no such column, it has "
                f"{', '.join(names)}"
            )
        if meaning == "time" and given.get("time_unit") == "frame":
            meaning = "frame"
        given_columns[meaning] = Meaning(column, plain(column)[1], "given")
    clocks = {"time", "frame"}
    left_out |= clocks if clocks & given_columns.keys() else set()
    taken = {meaning.column for meaning in given_columns.values()}
    return {
        name: meaning
        for name, meaning in recognised_columns.items()
        if name not in left_out and meaning.column not in taken
    } | given_columns


def _check_units(raw: Raw, measured: Scaled, rate: float | None, stated: Mapping[str, str]) -> None:
    """Refuse units, or rates of frames, that may be two things.

    Raises:
        ConfigError: names both.
    """
    doubts = measured.doubts(rate)
    if "units" in doubts and not stated:
        raise ConfigError(f"{raw.path}: {doubts['units']}")
    if len(measured.rates(rate)) > 1:
        raise ConfigError(f"{raw.path}: {doubts['rate']}")


def _si(scale: Scale) -> bool:
    return (scale.position, scale.time, scale.rate, scale.speed) == ("m", "s", None, "m/s")


def _line(raw: Raw, columns: Mapping[str, Meaning], measured: Scaled, group: str) -> str:
    named = ", ".join(f"{meaning} = {column.column}" for meaning, column in columns.items())
    words, scale = f"{measured.scale} ({certainty(measured.share)})", measured.scale
    if scale.rate is not None and raw.rate not in (None, scale.rate):
        words = (
            f"{replace(scale, rate=raw.rate)} as stated in the file; {scale.rate:g} frames/s fit"
        )
    return f"{raw.path}: recognised {named}; {words}; read as data={group}"


def native_source(raw: Raw, meanings: Mapping[str, Meaning]) -> str | None:
    """The source with a reader for exactly these columns."""
    names = set(map(str, raw.frame.columns))
    if names >= _NGSIM:
        return "ngsim"
    if raw.path.name.endswith(TRACKS):
        return "highd"
    if names >= _RUNS and "agent" not in meanings:
        return "astazero"
    return None


def source_of_native(raw: Raw) -> Recognised:
    """What reads a file of a format whose reader knows its columns and units."""
    path = str(raw.path.absolute())
    if raw.native == "esimas":
        name = raw.path.stem.removeprefix("sequence_data")
        min_vehicles = 2 if name.startswith("_") else 3
        folder = str(raw.path.absolute().parent)
        return Recognised(
            "esimas",
            EsimasOptions(source=folder, recording=name.lstrip("_"), min_vehicles=min_vehicles),
        )
    natives: dict[str, DataOptions] = {
        "ngsim": NgsimOptions(path=path),
        "highd": HighDOptions(path=path),
        "sumo": SumoOptions(path=path),
        "jupedsim": WalkwayOptions(name="jupedsim", path=path),
        "openacc": OpenAccOptions(path=path, agents=Agents["global"]),
        "astazero": OpenAccOptions(name="astazero", path=path, agents=Agents["global"]),
    }
    return Recognised(raw.native, natives[raw.native])


def source_of(raw: Raw, scaled_table: Scaled) -> Recognised:
    """What reads a table.

    Args:
        scaled_table: its columns and units.
    """
    columns, scale, rows = scaled_table.meanings, scaled_table.scale, scaled_table.rows
    cut = "sequence" in columns
    if are_pairs(columns):
        return _recognised_table("pairs", raw, scaled_table)
    if scale.domain == "crowd" and not (cut and "frame" not in columns):
        return _people(raw, scaled_table)
    if scale.domain == "crowd":
        return _recognised_table("table", raw, scaled_table, domain=scale.domain)
    start, end = rows.ends()
    back = bool(np.median(rows.x[end, 0] - rows.x[start, 0]) < 0)
    exact = all(name in columns and columns[name].column == name for name in table.REQUIRED)
    if cut and "lane" not in columns and not back and (exact or _together(rows)):
        return _recognised_table("table", raw, scaled_table, domain=scale.domain)
    options: dict[str, Any] = {}
    if rows.dt > VehicleTableOptions.dt:
        options["dt"] = float(f"{rows.dt:.6g}")
    if back:
        options["direction"] = -1
    each = {"time": np.round(rows.time / rows.dt)}
    each |= {n: getattr(rows, n) for n in ("lane", "recording") if getattr(rows, n) is not None}
    # the greatest number of vehicles in one lane at one time
    most = int(pd.DataFrame(each).groupby(list(each)).size().max())
    if most < VehicleTableOptions.min_vehicles:
        options["min_vehicles"] = max(most, 1)
    return _recognised_table("vehicles", raw, scaled_table, **options)


def _recognised_table(group: str, raw: Raw, scaled_table: Scaled, **options: Any) -> Recognised:
    """A table's reader, its columns where they have other names than it gives them, and units."""
    kind, reader = _TABLES[group]
    columns, scale = scaled_table.columns, scaled_table.scale
    if scale.domain == "traffic":
        columns.pop("y", None)
    held = set(map(str, raw.frame.columns))
    named: dict[str, str | None] = {}
    for name in (*reader.REQUIRED, *reader.OPTIONAL):
        meaning = clock_of(columns) if name == "time" else CALLED.get(name, name)
        # a column of that name that means something else must not be read for it
        other = name in held and meaning in NAMES
        if columns.get(meaning) != name and (meaning in columns or other):
            named[name] = columns.get(meaning)
    options |= {"columns": named, "position_unit": scale.position}
    options |= {"time_unit": scale.time, "frame_rate": scale.rate}
    if {"speed", "v_follower"} & set(columns) and hasattr(kind, "speed_unit"):
        options["speed_unit"] = scale.speed
    return Recognised(group, kind(path=str(raw.path.absolute()), **options))  # type: ignore[call-arg]


def _people(raw: Raw, scaled_table: Scaled) -> Recognised:
    scale, rows, columns = scaled_table.scale, scaled_table.rows, scaled_table.columns
    dt = rows.dt
    if scale.rate is not None and raw.rate is not None:  # what the file states is taken
        dt *= scale.rate / raw.rate
        scale = replace(scale, rate=raw.rate)
    steps = max(2, round(1 / dt))
    options: dict[str, Any] = {}
    if abs(1 / dt - steps) >= 1e-3:
        options["t_seq"] = float(f"{steps * dt:.9g}")
    if np.ptp(rows.x[:, 1]) > np.ptp(rows.x[:, 0]):
        options["walking_axis"] = "y"
    ordered = list(columns) == ["agent", "frame", "x", "y"]
    ordered &= list(columns.values()) == list(map(str, raw.frame.columns[:4]))
    every = scale.rate is not None and abs(dt * scale.rate - 1) < 1e-6  # frame by frame
    plain_text = not raw.layout.named and raw.layout.separator == " "
    text = plain_text and ordered and scale.position in ("cm", "m")
    if text and every:
        if raw.rate is None:
            options["frame_rate"] = scale.rate
        if raw.layout.unit is None:
            options["unit"] = scale.position
        return Recognised("pedpy", WalkwayOptions(path=str(raw.path.absolute()), **options))
    return _recognised_table("pedpy", raw, replace(scaled_table, scales=[scale]), **options)


def _together(rows: Trajectories) -> bool:
    """Whether most agents are in their part of the table from its first to its last time."""
    start, end = rows.ends()
    part = np.zeros(len(rows)) if rows.recording is None else rows.recording
    clock = pd.Series(rows.time).groupby(part)
    begins = (rows.time - clock.transform("min").to_numpy())[start] < rows.dt / 2
    ends = (clock.transform("max").to_numpy() - rows.time)[end] < rows.dt / 2
    return bool((begins & ends).mean() > 0.5)
