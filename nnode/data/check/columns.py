"""What the columns of a table mean: by their names, or, where there are none, by what they hold."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from nnode.data.check.raw import Raw
from nnode.data.readers.columns import floats

#: Names by meaning, small letters and digits only; the first is the meaning's own.
NAMES: dict[str, list[str]] = {
    meaning: usual.split()
    for meaning, usual in {
        "agent": "agent id vehicle vehicleid veh vehid vid track trackid car carid person "
        "personid pid ped pedid pedestrian pedestrianid agentid object objectid obj "
        "objid targetid name",
        "time": "time t timestamp globaltime seconds sec datetime epoch",
        "frame": "frame frameid framenumber framenum frameindex fr step",
        "x": "x posx xpos positionx xposition localy position pos station distance s px "
        "xcoord xcenter xm east easting frontx",
        "y": "y posy ypos positiony yposition localx lateral py ycoord ycenter ym north northing d",
        "lane": "lane laneid laneno lanenumber laneindex",
        "speed": "speed v vel velocity vvel spd speedmps",
        "vx": "vx xvelocity velx velocityx xvel speedx",
        "vy": "vy yvelocity vely velocityy yvel speedy",
        "length": "length len vlength vehiclelength vehlength carlength",
        "kind": "kind class cls type vclass vehicletype vehicleclass agenttype",
        "sequence": "sequence seq scene sceneid segment episode trial platoon",
        "recording": "recording recordingid run runno location session dataset",
        "x_follower": "xfollower xfollowerreal xf followerx xfollowing xfoll",
        "x_leader": "xleader xleaderreal xl leaderx xlead xpreceding",
        "v_follower": "vfollower vfollowerreal vf followerv vfollowing followerspeed",
        "v_leader": "vleader vleaderreal vl leaderv vlead leaderspeed",
        "leader_length": "leaderlength lengthleader lleader",
        "spacing": "spacing gap spaceheadway ivs",
        "pair": "pair pairid event eventid",
        "follower": "follower followerid following",
        "leader": "leader leaderid preceding precedingid",
        "split": "split",
        "leader_kind": "leaderkind leadertype",
        "position": "order rank place",
    }.items()
}
#: Units that a name may end in, with their own names.
UNITS = {
    ending: unit
    for unit, endings in {
        "m": "m",
        "cm": "cm",
        "mm": "mm",
        "ft": "ft feet",
        "km": "km",
        "s": "s sec",
        "ms": "ms",
        "frame": "frames",
        "m/s": "m/s mps ms-1",
        "km/h": "km/h kmh kph",
        "mph": "mph",
        "ft/s": "ft/s fps",
    }.items()
    for ending in endings.split()
}
_ENDING = re.compile(
    r"(?:\s*[\[(/]\s*|[_ ])("
    + "|".join(map(re.escape, sorted(UNITS, key=len, reverse=True)))
    + r")\s*[\])]?$",
    re.IGNORECASE,
)
#: Meanings whose cells are names, not numbers.
_WORDS = {
    *("agent", "lane", "kind", "sequence", "recording", "split"),
    *("pair", "follower", "leader", "leader_kind"),
}
#: Share of a column's cells that must be numbers where its meaning needs them.
MOSTLY = 0.5


@dataclass(frozen=True)
class Meaning:
    """A column and what it is taken for.

    Attributes:
        column: its name in the table.
        unit: that its name ends in; empty: none.
        sure: ``named`` exactly, ``like`` a usual name, by what it ``holds``, or as it was
            ``given``.
        rivals: further columns of usual names of that meaning, which hold other values.
    """

    column: str
    unit: str
    sure: str
    rivals: tuple[str, ...] = ()


def clock_of(meanings: Collection[str]) -> str:
    """The meaning of the column that times are from, ``time`` or ``frame``."""
    return "time" if "time" in meanings else "frame"


def are_pairs(meanings: Collection[str]) -> bool:
    """Whether meanings are those of a follower and its leader, with or without positions."""
    return {"x_follower", "x_leader"} <= set(meanings) or is_spaced(meanings)


def is_spaced(meanings: Collection[str]) -> bool:
    """Whether meanings are those of pairs whose positions follow from spacing and speeds."""
    return {"spacing", "v_follower", "v_leader"} <= set(meanings) and not (
        {"x", "x_follower", "x_leader"} & set(meanings)
    )


def rivals(meanings: Mapping[str, Meaning]) -> dict[str, str]:
    """By meaning, that more than one column may have it, in words."""
    return {
        meaning: f"the column of {meaning} may be {column.column} or "
        f"{' or '.join(column.rivals)}, which hold different values; say which, as in "
        f"data.columns.{meaning}={column.column}"
        for meaning, column in meanings.items()
        if column.rivals
    }


def plain(name: str) -> tuple[str, str]:
    """A column's name in small letters and digits, and the unit that it ends in."""
    unit = ""
    match = _ENDING.search(name)
    if match and match.start() > 0:
        unit, name = UNITS[match[1].lower()], name[: match.start()]
    return _letters(name), unit


def _letters(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def in_seconds(raw: Raw) -> Raw:
    """Dates, clock times and durations in columns that are named like times, as the readers take
    them: seconds after the first.

    Raises:
        DataError: a cell of them that is none; names the row.
    """
    if raw.table is None or not raw.layout.named:
        return raw
    held = {}
    for column, cells in raw.frame.items():
        if plain(str(column))[0] not in NAMES["time"] or pd.api.types.is_numeric_dtype(cells):
            continue
        if cells.dtype.kind in "mM" or cells.astype("string").str.contains(r"\d[-:]\d").any():
            held[str(column)] = raw.table.times(str(column))[1]
    if held:
        raw.table.frame = raw.frame.assign(**held)
    return replace(raw, dated=tuple(held))


def numbers(frame: pd.DataFrame, column: str) -> np.ndarray:
    """A column as float64, NaN where a cell holds no finite number."""
    values = floats(frame[column])
    return np.where(np.isfinite(values), values, np.nan)


def meanings(raw: Raw) -> dict[str, Meaning]:
    """What the columns mean, as far as that can be told."""
    frame = raw.frame
    if not raw.layout.named:
        return {
            m: Meaning(c, raw.layout.unit or "", "holds") for m, c in _by_content(frame).items()
        }
    recognised: dict[str, Meaning] = {}
    # a name as a whole, and without the unit that it ends in
    parsed = {name: (_letters(name), *plain(name)) for name in map(str, frame.columns)}
    for meaning, usual in NAMES.items():
        candidates: dict[str, int] = {}
        for place in (0, 1):
            for column, words in parsed.items():
                if words[place] in usual:
                    candidates.setdefault(column, usual.index(words[place]))
        fit = [
            column
            for column in sorted(candidates, key=lambda c: candidates[c])
            if meaning in _WORDS or np.isfinite(numbers(frame, column)).mean() > MOSTLY
        ]
        if fit:
            column = fit[0]
            whole, _, unit = parsed.pop(column)
            sure = "named" if column == meaning else "like"
            # the own name of a meaning leaves no doubt
            others = () if whole == usual[0] else _others(frame, column, fit[1:])
            recognised[meaning] = Meaning(column, "" if whole in usual else unit, sure, others)
    return recognised


def _others(frame: pd.DataFrame, column: str, rivals: list[str]) -> tuple[str, ...]:
    """Those of some columns that part the rows otherwise than a column does."""
    groups = pd.factorize(frame[column])[0]
    return tuple(
        rival for rival in rivals if not np.array_equal(pd.factorize(frame[rival])[0], groups)
    )


def _by_content(frame: pd.DataFrame) -> dict[str, str]:
    """Columns of rows of numbers: agent and frame in either order, positions, velocities."""
    names = [str(name) for name in frame.columns]
    if len(names) < 4:
        return {}
    first, second = numbers(frame, names[0]), numbers(frame, names[1])
    if len(names) == 8:  # frame id x z y vx vz vy: obsmat of Pellegrini et al. 2009
        places = [numbers(frame, name) for name in (names[2], names[4])]
        order: tuple[str, ...] = ("x", "", "y", "vx", "", "vy")
    else:
        places = [numbers(frame, name) for name in names[2:4]]
        order = ("x", "y")
    forth = _roughness(first, second, places)
    back = _roughness(second, first, places)
    ids = ("agent", "frame") if forth <= back else ("frame", "agent")
    return {m: c for m, c in zip((*ids, *order), names, strict=False) if m}


def _roughness(agent: np.ndarray, frame: np.ndarray, places: list[np.ndarray]) -> float:
    """Median distance between neighbouring rows of one agent, ties of agent and frame counting."""
    order = np.lexsort((frame, agent))
    same = np.diff(agent[order]) == 0
    if not same.any():
        return np.inf
    steps = np.sqrt(sum(np.diff(place[order]) ** 2 for place in places))
    usual = float(np.nanmedian(steps[same])) if np.isfinite(steps[same]).any() else np.inf
    ties = float((np.diff(frame[order])[same] == 0).mean())
    return np.inf if ties > 0.5 else usual
