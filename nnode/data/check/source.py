"""Which data source reads a file, with which options; or how to make a file that one reads."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from nnode.data.check.columns import Meaning, numbers
from nnode.data.check.raw import Raw
from nnode.data.check.scale import Scale
from nnode.data.check.tracks import Tracks
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

_NGSIM = {"Vehicle_ID", "Frame_ID", "Global_Time", "Local_Y", "Lane_ID"}
#: Column that is made of two, where a table has recordings and sequences in them.
JOINT = "recording and sequence"

_TABLE = {"sequence", "time", "agent", "x"}
_RUNS = {"run", "position", "t", "v", "gap"}


@dataclass(frozen=True)
class Source:
    """A data source.

    Attributes:
        group: its name in ``conf/data``.
        options: that read the file.
        convert: lines of Python that make a table which a source reads; then there are no options
            for the file as it is.
    """

    group: str
    options: DataOptions
    convert: list[str] = field(default_factory=list)


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
    tracks: Tracks | None = None,
) -> Source:
    """The source of a file.

    Args:
        found: column by meaning, where the format does not fix them.
        scale: units.
        tracks: the rows in SI units.
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
    assert tracks is not None
    if are_pairs(found):
        return _pairs(raw, found, scale, path)
    if scale.domain == "crowd":
        return _people(raw, found, scale, tracks, path)
    return _vehicles(raw, found, scale, tracks, path)


def _esimas(path: Path) -> Source:
    name = path.stem.removeprefix("sequence_data")
    least = 2 if name.startswith("_") else 3
    folder = str(path.absolute().parent)
    options = EsimasOptions(source=folder, recording=name.lstrip("_"), min_vehicles=least)
    return Source("esimas", options)


def _plain(raw: Raw) -> bool:
    """Whether tables are read as this one is written."""
    return raw.named and raw.separator in (",", "")


def _people(
    raw: Raw, found: Mapping[str, Meaning], scale: Scale, tracks: Tracks, path: str
) -> Source:
    columns = {meaning: one.column for meaning, one in found.items()}
    if "sequence" in columns:
        return _tidy(raw, found, scale, path)
    rate = people_rate(tracks)
    steps = max(2, round(rate))
    own: dict[str, Any] = {"t_seq": float(f"{steps / rate:.9g}")} if rate != round(rate) else {}
    if np.ptp(tracks.x[:, 1]) > np.ptp(tracks.x[:, 0]):
        own["walking_axis"] = "y"
    order = [raw.table.frame.columns.get_loc(columns[m]) for m in columns] if raw.table else []
    ordered = list(columns) == ["agent", "frame", "x", "y"] and order == [0, 1, 2, 3]
    every = scale.rate is not None and abs(rate / scale.rate - 1) < 1e-6  # frame by frame
    text = not raw.named and raw.separator == " " and ordered and scale.position in ("cm", "m")
    if text and every:
        if raw.rate is None:
            own["frame_rate"] = rate
        if raw.unit is None:
            own["unit"] = scale.position
        return Source("pedpy", WalkwayOptions(path=path, **own))
    made = raw.path.with_name(f"{raw.path.stem}_people.txt").absolute()
    own["path"] = str(made)
    return Source("pedpy", WalkwayOptions(**own), _to_people(raw, columns, scale, rate, made))


def people_rate(tracks: Tracks) -> float:
    """Samples of people per second."""
    return float(f"{1 / tracks.dt:.9g}")


def people_of(raw: Raw, found: Mapping[str, Meaning], scale: Scale, rate: float) -> pd.DataFrame:
    """Rows id, frame, x, y (m) of a table of people, as the lines of :func:`_to_people` make them.

    Args:
        rate: samples per second.
    """
    assert raw.table is not None
    frame = raw.table.frame
    columns = {meaning: one.column for meaning, one in found.items()}
    clock = numbers(frame, columns["time" if "time" in columns else "frame"])
    number = np.round(rate * scale.seconds * clock)
    runs = [columns[m] for m in ("recording", "sequence") if m in columns]
    if runs:
        number += (np.nanmax(number) - np.nanmin(number) + 1) * frame.groupby(runs).ngroup()
    who = frame[[*runs, columns["agent"]]].astype(str).agg(" ".join, axis=1)
    made = pd.DataFrame({"id": pd.factorize(who)[0], "frame": number})
    for axis in ("x", "y"):
        made[axis] = scale.metres * numbers(frame, columns[axis])
    return made.dropna().astype({"frame": np.int64})


def _together(tracks: Tracks) -> bool:
    """Whether most agents are in their part of the table from its first to its last time."""
    start = np.flatnonzero(np.diff(tracks.agent, prepend=-1) != 0)
    end = np.append(start[1:], len(tracks)) - 1
    part = np.zeros(len(tracks), dtype=int) if tracks.part is None else tracks.part
    first, last = np.full(part.max() + 1, np.inf), np.full(part.max() + 1, -np.inf)
    np.minimum.at(first, part, tracks.time)
    np.maximum.at(last, part, tracks.time)
    near = tracks.dt / 2
    begins = tracks.time[start] - first[part[start]] < near
    ends = last[part[end]] - tracks.time[end] < near
    return bool((begins & ends).mean() > 0.5)


def _tidy(raw: Raw, found: Mapping[str, Meaning], scale: Scale, path: str) -> Source:
    """Sequences that are cut already."""
    columns = {meaning: one.column for meaning, one in found.items()}
    meant = {"time": "time" if "time" in columns else "frame"}
    axes = ("x", "y") if scale.domain == "crowd" else ("x",)
    meant |= {name: name for name in ("sequence", "agent", *axes, "length", "kind", "recording")}
    named = _named(raw, columns, meant)
    if scale.domain == "traffic" and raw.table is not None and "y" in raw.table.frame.columns:
        named["y"] = None
    own: dict[str, Any] = {"columns": named, "position_unit": scale.position}
    own |= {"time_unit": scale.time, "frame_rate": scale.rate, "domain": scale.domain}
    place, lines = _commas(raw, path)
    return Source("table", TableOptions(path=place, **own), lines)


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


def _commas(raw: Raw, path: str, *change: str) -> tuple[str, list[str]]:
    """Where the table is with commas between its cells, and the lines that write it there."""
    if _plain(raw) and not change:
        return path, []
    made = str(raw.path.with_name(f"{raw.path.stem}_commas.csv").absolute())
    read = ["import pandas as pd", "", *_read(raw)]
    return made, [*read, *change, f"t.to_csv({made!r}, index=False)"]


def _to_people(
    raw: Raw, columns: Mapping[str, str], scale: Scale, rate: float, made: Path
) -> list[str]:
    clock = columns["time" if "time" in columns else "frame"]
    samples = rate * scale.seconds  # by unit of the file's time
    frames = f"({samples:.9g} * t[{clock!r}]).round().astype(int)"
    metres = f"{scale.metres:g} * " if scale.metres != 1 else ""
    whose = [columns[m] for m in ("recording", "sequence", "agent") if m in columns]
    who = f"t[{whose[0]!r}]"
    lines = [f"frame = {frames}"]
    if len(whose) > 1:
        who = f"t[{whose!r}].astype(str).agg(' '.join, axis=1)"
        # people of two recordings never meet: one recording begins when the other one has ended
        lines.append(
            f"frame += (frame.max() - frame.min() + 1) * t.groupby({whose[:-1]!r}).ngroup()"
        )
    return [
        "import pandas as pd",
        "",
        *_read(raw),
        *lines,
        "people = pd.DataFrame({",
        f"    'id': pd.factorize({who})[0], 'frame': frame,",
        f"    'x': {metres}t[{columns['x']!r}], 'y': {metres}t[{columns['y']!r}], 'z': 0}})",
        f"with open({str(made)!r}, 'w') as file:",
        f"    file.write('# framerate: {rate:.9g}\\n# id frame x/m y/m z/m\\n')",
        "    people.to_csv(file, sep=' ', header=False, index=False)",
    ]


def _read(raw: Raw) -> list[str]:
    if not raw.separator:
        return [f"t = pd.read_parquet({str(raw.path.absolute())!r})", *_seconds(raw)]
    how = [repr(str(raw.path.absolute()))]
    if raw.separator != ",":
        how.append("sep=r'\\s+'" if raw.separator == " " else f"sep={raw.separator!r}")
    if raw.decimal != ".":
        how.append(f"decimal={raw.decimal!r}")
    if not raw.named and raw.table is not None:
        names = [str(name) for name in raw.table.frame.columns]
        how.append(f"comment='#', names={names!r}")
    return [f"t = pd.read_csv({', '.join(how)})", *_seconds(raw)]


def _seconds(raw: Raw) -> list[str]:
    """Lines that make seconds of dates, clock times and durations."""
    if not raw.dated:
        return []
    return [
        "from nnode.data.readers.columns import Table",
        *(f"t[{name!r}] = Table(t).times({name!r})[1]" for name in raw.dated),
    ]  # fmt: skip


def _vehicles(
    raw: Raw, found: Mapping[str, Meaning], scale: Scale, tracks: Tracks, path: str
) -> Source:
    columns = {meaning: one.column for meaning, one in found.items()}
    start = np.flatnonzero(np.diff(tracks.agent, prepend=-1) != 0)
    end = np.append(start[1:], len(tracks)) - 1
    back = bool(np.median(tracks.x[end, 0] - tracks.x[start, 0]) < 0)
    exact = all(columns.get(name) == name for name in _TABLE)
    cut = "sequence" in columns and "lane" not in columns
    if cut and not back and (exact or _together(tracks)):
        return _tidy(raw, found, scale, path)
    clock = "time" if "time" in columns else "frame"
    meant = {"vehicle": "agent", "time": clock} | {
        name: name for name in ("x", "lane", "speed", "length", "kind", "recording")
    }
    whole = [columns[m] for m in ("recording", "sequence") if m in columns]
    columns = {**columns, **({"recording": whole[0]} if whole else {})}
    change: list[str] = []
    if len(whole) > 1:
        columns["recording"] = JOINT
        change = [f"t[{JOINT!r}] = t[{whole!r}].astype(str).agg(' '.join, axis=1)"]
    named = _named(raw, columns, meant)
    own: dict[str, Any] = {"columns": named, "position_unit": scale.position}
    if "speed" in columns:
        own["speed_unit"] = scale.speed
    own |= {"time_unit": scale.time}
    if scale.rate is not None:
        own["frame_rate"] = scale.rate
    if tracks.dt > VehicleTableOptions.dt:
        own["dt"] = float(f"{tracks.dt:.6g}")
    if back:
        own["direction"] = -1
    if _most(tracks) < VehicleTableOptions.min_vehicles:
        own["min_vehicles"] = max(_most(tracks), 1)
    place, lines = _commas(raw, path, *change)
    return Source("vehicles", VehicleTableOptions(path=place, **own), lines)


def joint(raw: Raw, found: Mapping[str, Meaning]) -> pd.Series:
    """Names of recording and sequence of every row."""
    assert raw.table is not None
    whole = [found[m].column for m in ("recording", "sequence")]
    return raw.table.frame[whole].astype(str).agg(" ".join, axis=1)


def _most(tracks: Tracks) -> int:
    """The greatest number of vehicles in one lane at one time."""
    where = np.zeros(len(tracks)) if tracks.lane is None else tracks.lane
    part = np.zeros(len(tracks)) if tracks.part is None else tracks.part
    each = np.stack([np.round(tracks.time / tracks.dt), where, part])
    return int(np.unique(each, axis=1, return_counts=True)[1].max())


def _pairs(raw: Raw, found: Mapping[str, Meaning], scale: Scale, path: str) -> Source:
    meant = {
        "time": "time", "run": "recording", "lane": "lane",
        **{name: name for name in (
            "pair", "x_follower", "x_leader", "v_follower", "v_leader", "leader_length", "spacing",
            "follower", "leader", "split", "leader_kind",
        )},
    }  # fmt: skip
    columns = {m: one.column for m, one in found.items()}
    named = {name: columns[m] for name, m in meant.items() if m in columns and name != columns[m]}
    own: dict[str, Any] = {"columns": named, "position_unit": scale.position}
    if "v_follower" in columns:
        own["speed_unit"] = scale.speed
    if scale.rate is None and _plain(raw) and "time" in columns:
        return Source("pairs", PairOptions(path=path, time_unit=scale.time, **own))
    made = str(raw.path.with_name(f"{raw.path.stem}_pairs.csv").absolute())
    clock = columns.get("time", columns.get("frame", ""))
    named["time"] = "time"
    lines = [
        "import pandas as pd", "", *_read(raw), f"t['time'] = {scale.seconds:.9g} * t[{clock!r}]",
        f"t.to_csv({made!r}, index=False)",
    ]  # fmt: skip
    return Source("pairs", PairOptions(path=made, **own), lines)
