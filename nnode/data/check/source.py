"""Which data source reads a file, with which options; or how to make a file that one reads."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from nnode.data.check.columns import Meaning, clock_of
from nnode.data.check.raw import Raw
from nnode.data.check.scale import Scale
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
from nnode.data.readers.highd import TRACKS
from nnode.data.trajectories import Trajectories

_NGSIM = {"Vehicle_ID", "Frame_ID", "Global_Time", "Local_Y", "Lane_ID"}

_TABLE = {"sequence", "time", "agent", "x"}
_RUNS = {"run", "position", "t", "v", "gap"}


@dataclass(frozen=True)
class Source:
    """A data source.

    Attributes:
        group: its name in ``conf/data``.
        options: that read the file.
    """

    group: str
    options: DataOptions


def native_source(raw: Raw, found: Mapping[str, Meaning]) -> str | None:
    """The source with a reader for exactly these columns."""
    assert raw.table is not None
    names = {str(name) for name in raw.table.frame.columns}
    if names >= _NGSIM:
        return "ngsim"
    if raw.path.name.endswith(TRACKS):
        return "highd"
    if names >= _RUNS and "agent" not in found:
        return "astazero"
    return None


def are_pairs(found: Mapping[str, Meaning]) -> bool:
    """Whether rows are of a follower and its leader, with or without positions."""
    return {"x_follower", "x_leader"} <= set(found) or is_spaced(found)


def is_spaced(found: Mapping[str, Meaning]) -> bool:
    """Whether rows are of pairs whose positions follow from spacing and speeds."""
    return {"spacing", "v_follower", "v_leader"} <= set(found) and not (
        {"x", "x_follower", "x_leader"} & set(found)
    )


def source_of(
    raw: Raw,
    found: Mapping[str, Meaning] | None = None,
    scale: Scale | None = None,
    rows: Trajectories | None = None,
) -> Source:
    """The source of a file.

    Args:
        found: column by meaning, where the format does not fix them.
        scale: units.
        rows: in order and in SI units.
    """
    path = str(raw.path.absolute())
    if raw.native == "esimas":
        return _esimas(raw.path)
    natives: dict[str, DataOptions] = {
        "ngsim": NgsimOptions(path=path),
        "highd": HighDOptions(path=path),
        "sumo": SumoOptions(path=path),
        "jupedsim": WalkwayOptions(name="jupedsim", path=path),
        "openacc": OpenAccOptions(path=path, agents=Agents["global"]),
        "astazero": OpenAccOptions(name="astazero", path=path, agents=Agents["global"]),
    }
    if raw.native:
        return Source(raw.native, natives[raw.native])
    assert found is not None
    assert scale is not None
    assert rows is not None
    if are_pairs(found):
        return _pairs(raw, found, scale, path)
    if scale.domain == "crowd":
        return _people(raw, found, scale, rows, path)
    return _vehicles(raw, found, scale, rows, path)


def _esimas(path: Path) -> Source:
    name = path.stem.removeprefix("sequence_data")
    least = 2 if name.startswith("_") else 3
    folder = str(path.absolute().parent)
    options = EsimasOptions(source=folder, recording=name.lstrip("_"), min_vehicles=least)
    return Source("esimas", options)


def _people(
    raw: Raw, found: Mapping[str, Meaning], scale: Scale, rows: Trajectories, path: str
) -> Source:
    columns = {meaning: one.column for meaning, one in found.items()}
    if "sequence" in columns and "frame" not in columns:
        return _tidy(raw, found, scale, path)
    dt = rows.dt
    if scale.rate is not None and raw.rate is not None:  # what the file tells is taken
        dt *= scale.rate / raw.rate
        scale = replace(scale, rate=raw.rate)
    steps = max(2, round(1 / dt))
    whole = abs(1 / dt - steps) < 1e-3
    own: dict[str, Any] = {} if whole else {"t_seq": float(f"{steps * dt:.9g}")}
    if np.ptp(rows.x[:, 1]) > np.ptp(rows.x[:, 0]):
        own["walking_axis"] = "y"
    order = [raw.table.frame.columns.get_loc(columns[m]) for m in columns] if raw.table else []
    ordered = list(columns) == ["agent", "frame", "x", "y"] and order == [0, 1, 2, 3]
    every = scale.rate is not None and abs(dt * scale.rate - 1) < 1e-6  # frame by frame
    text = not raw.named and raw.separator == " " and ordered and scale.position in ("cm", "m")
    if text and every:
        if raw.rate is None:
            own["frame_rate"] = scale.rate
        if raw.unit is None:
            own["unit"] = scale.position
        return Source("pedpy", WalkwayOptions(path=path, **own))
    meant = {name: name for name in ("agent", "x", "y", "recording", "sequence")}
    meant["time"] = clock_of(found)
    own |= {"columns": _named(raw, columns, meant), "frame_rate": scale.rate}
    own |= {"position_unit": scale.position, "time_unit": scale.time}
    return Source("pedpy", WalkwayOptions(path=path, **own))


def _together(rows: Trajectories) -> bool:
    """Whether most agents are in their part of the table from its first to its last time."""
    start, end = rows.ends()
    part = np.zeros(len(rows)) if rows.recording is None else rows.recording
    clock = pd.Series(rows.time).groupby(part)
    begins = (rows.time - clock.transform("min").to_numpy())[start] < rows.dt / 2
    ends = (clock.transform("max").to_numpy() - rows.time)[end] < rows.dt / 2
    return bool((begins & ends).mean() > 0.5)


def _tidy(raw: Raw, found: Mapping[str, Meaning], scale: Scale, path: str) -> Source:
    """Sequences that are cut already."""
    columns = {meaning: one.column for meaning, one in found.items()}
    meant = {"time": clock_of(found)}
    axes = ("x", "y") if scale.domain == "crowd" else ("x",)
    meant |= {name: name for name in ("sequence", "agent", *axes, "length", "kind", "recording")}
    named = _named(raw, columns, meant)
    if scale.domain == "traffic" and raw.table is not None and "y" in raw.table.frame.columns:
        named["y"] = None
    own: dict[str, Any] = {"columns": named, "position_unit": scale.position}
    own |= {"time_unit": scale.time, "frame_rate": scale.rate, "domain": scale.domain}
    return Source("table", TableOptions(path=path, **own))


def _named(raw: Raw, columns: Mapping[str, str], meant: Mapping[str, str]) -> dict[str, str | None]:
    """A reader's columns by their meaning to it, where they have other names than that.

    A table's own column of a name that means something else must not be read for it.
    """
    held = set() if raw.table is None else {str(name) for name in raw.table.frame.columns}
    return {
        name: columns.get(m)
        for name, m in meant.items()
        if (name != columns[m] if m in columns else name in held)
    }


def _vehicles(
    raw: Raw, found: Mapping[str, Meaning], scale: Scale, rows: Trajectories, path: str
) -> Source:
    columns = {meaning: one.column for meaning, one in found.items()}
    start, end = rows.ends()
    back = bool(np.median(rows.x[end, 0] - rows.x[start, 0]) < 0)
    exact = all(columns.get(name) == name for name in _TABLE)
    cut = "sequence" in columns and "lane" not in columns
    if cut and not back and (exact or _together(rows)):
        return _tidy(raw, found, scale, path)
    clock = clock_of(found)
    meant = {"vehicle": "agent", "time": clock} | {
        name: name for name in ("x", "lane", "speed", "length", "kind", "recording", "sequence")
    }
    named = _named(raw, columns, meant)
    own: dict[str, Any] = {"columns": named, "position_unit": scale.position}
    if "speed" in columns:
        own["speed_unit"] = scale.speed
    own |= {"time_unit": scale.time}
    if scale.rate is not None:
        own["frame_rate"] = scale.rate
    if rows.dt > VehicleTableOptions.dt:
        own["dt"] = float(f"{rows.dt:.6g}")
    if back:
        own["direction"] = -1
    if _most(rows) < VehicleTableOptions.min_vehicles:
        own["min_vehicles"] = max(_most(rows), 1)
    return Source("vehicles", VehicleTableOptions(path=path, **own))


def _most(rows: Trajectories) -> int:
    """The greatest number of vehicles in one lane at one time."""
    each = {"time": np.round(rows.time / rows.dt)}
    each |= {n: getattr(rows, n) for n in ("lane", "recording") if getattr(rows, n) is not None}
    return int(pd.DataFrame(each).groupby(list(each)).size().max())


def _pairs(raw: Raw, found: Mapping[str, Meaning], scale: Scale, path: str) -> Source:
    meant = {
        "time": "time",
        "run": "recording",
        "lane": "lane",
        **{
            name: name
            for name in (
                "pair",
                "x_follower",
                "x_leader",
                "v_follower",
                "v_leader",
                "leader_length",
                "spacing",
                "follower",
                "leader",
                "split",
                "leader_kind",
            )
        },
    }
    columns = {m: one.column for m, one in found.items()}
    named = {name: columns[m] for name, m in meant.items() if m in columns and name != columns[m]}
    own: dict[str, Any] = {"columns": named, "position_unit": scale.position}
    if "v_follower" in columns:
        own["speed_unit"] = scale.speed
    if "time" not in columns and columns.get("frame", "time") != "time":
        named["time"] = columns["frame"]
    own |= {"time_unit": scale.time, "frame_rate": scale.rate}
    return Source("pairs", PairOptions(path=path, **own))
