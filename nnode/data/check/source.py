"""Which data source reads a file, with which options."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from nnode.data.check.columns import NAMES, Meaning, are_pairs, clock_of
from nnode.data.check.raw import Raw
from nnode.data.check.rows import Scaled
from nnode.data.options import (
    Agents,
    DataOptions,
    EsimasOptions,
    HighDOptions,
    NgsimOptions,
    OpenAccOptions,
    PairOptions,
    SumoOptions,
    TableOptions,
    VehicleTableOptions,
    WalkwayOptions,
)
from nnode.data.readers import jupedsim, pairs, table, vehicles
from nnode.data.readers.columns import Table
from nnode.data.readers.highd import TRACKS
from nnode.data.trajectories import Trajectories

_NGSIM = {"Vehicle_ID", "Frame_ID", "Global_Time", "Local_Y", "Lane_ID"}

_RUNS = {"run", "position", "t", "v", "gap"}

#: Meanings that readers call by another name.
CALLED = {"vehicle": "agent", "run": "recording"}
#: Options and readers of tables by the group.
_TABLES: dict[str, tuple[type[DataOptions], Any]] = {
    "vehicles": (VehicleTableOptions, vehicles),
    "table": (TableOptions, table),
    "pedpy": (WalkwayOptions, jupedsim),
    "pairs": (PairOptions, pairs),
}


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


def native_source(raw: Raw, meanings: Mapping[str, Meaning]) -> str | None:
    """The source with a reader for exactly these columns."""
    assert raw.table is not None
    names = {str(name) for name in raw.table.frame.columns}
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
        least = 2 if name.startswith("_") else 3
        folder = str(raw.path.absolute().parent)
        return Recognised(
            "esimas",
            EsimasOptions(source=folder, recording=name.lstrip("_"), min_vehicles=least),
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
        return _of_table("pairs", raw, scaled_table)
    if scale.domain == "crowd":
        if cut and "frame" not in columns:
            return _of_table("table", raw, scaled_table, domain=scale.domain)
        return _people(raw, scaled_table)
    start, end = rows.ends()
    back = bool(np.median(rows.x[end, 0] - rows.x[start, 0]) < 0)
    exact = all(name in columns and columns[name].column == name for name in table.REQUIRED)
    if cut and "lane" not in columns and not back and (exact or _together(rows)):
        return _of_table("table", raw, scaled_table, domain=scale.domain)
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
    return _of_table("vehicles", raw, scaled_table, **options)


def _of_table(group: str, raw: Raw, scaled_table: Scaled, **options: Any) -> Recognised:
    """A table's reader, its columns where they have other names than it gives them, and units."""
    assert raw.table is not None
    kind, reader = _TABLES[group]
    columns = {m: recognised.column for m, recognised in scaled_table.meanings.items()}
    if scaled_table.scale.domain == "traffic":
        columns.pop("y", None)
    held = set(map(str, raw.table.frame.columns))
    named: dict[str, str | None] = {}
    for name in (*reader.REQUIRED, *reader.OPTIONAL):
        meaning = clock_of(columns) if name == "time" else CALLED.get(name, name)
        # a column of that name that means something else must not be read for it
        other = name in held and meaning in NAMES
        if columns.get(meaning) != name and (meaning in columns or other):
            named[name] = columns.get(meaning)
    options |= {"columns": named, "position_unit": scaled_table.scale.position}
    options |= {"time_unit": scaled_table.scale.time, "frame_rate": scaled_table.scale.rate}
    if {"speed", "v_follower"} & set(columns) and hasattr(kind, "speed_unit"):
        options["speed_unit"] = scaled_table.scale.speed
    return Recognised(group, kind(path=str(raw.path.absolute()), **options))  # type: ignore[call-arg]


def _people(raw: Raw, scaled_table: Scaled) -> Recognised:
    scale, rows = scaled_table.scale, scaled_table.rows
    columns = {meaning: recognised.column for meaning, recognised in scaled_table.meanings.items()}
    dt = rows.dt
    if scale.rate is not None and raw.rate is not None:  # what the file tells is taken
        dt *= scale.rate / raw.rate
        scale = replace(scale, rate=raw.rate)
    steps = max(2, round(1 / dt))
    options: dict[str, Any] = {}
    if abs(1 / dt - steps) >= 1e-3:
        options["t_seq"] = float(f"{steps * dt:.9g}")
    if np.ptp(rows.x[:, 1]) > np.ptp(rows.x[:, 0]):
        options["walking_axis"] = "y"
    order = [raw.table.frame.columns.get_loc(c) for c in columns.values()] if raw.table else []
    ordered = list(columns) == ["agent", "frame", "x", "y"] and order == [0, 1, 2, 3]
    every = scale.rate is not None and abs(dt * scale.rate - 1) < 1e-6  # frame by frame
    text = not raw.named and raw.separator == " " and ordered and scale.position in ("cm", "m")
    if text and every:
        if raw.rate is None:
            options["frame_rate"] = scale.rate
        if raw.unit is None:
            options["unit"] = scale.position
        return Recognised("pedpy", WalkwayOptions(path=str(raw.path.absolute()), **options))
    return _of_table("pedpy", raw, replace(scaled_table, scales=[scale]), **options)


def _together(rows: Trajectories) -> bool:
    """Whether most agents are in their part of the table from its first to its last time."""
    start, end = rows.ends()
    part = np.zeros(len(rows)) if rows.recording is None else rows.recording
    clock = pd.Series(rows.time).groupby(part)
    begins = (rows.time - clock.transform("min").to_numpy())[start] < rows.dt / 2
    ends = (clock.transform("max").to_numpy() - rows.time)[end] < rows.dt / 2
    return bool((begins & ends).mean() > 0.5)
