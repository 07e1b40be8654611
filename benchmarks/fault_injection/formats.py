"""Sound files of other programs, and what reads them without the last resort for foreign errors."""

from __future__ import annotations

import gzip
import pickle
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pandas as pd

from nnode.data.identity import identify
from nnode.data.options import DataOptions
from nnode.data.prepare import FORMATS
from nnode.data.quality import drop_absent, find_faults
from nnode.data.readers.highd import RECORDING_META, TRACKS, TRACKS_META, HighDOptions
from nnode.data.sequence import Domain, Sequence
from nnode.data.sequences import Sequences

ROOM = "POLYGON ((0 0, 20 0, 20 4, 0 4, 0 0), (4 1, 5 1, 5 2, 4 2, 4 1))"


def read_all(options: DataOptions, files: dict[str, Any]) -> None:
    """Read files and look for faults, without the last resort for foreign errors."""
    sequences: list[Sequence] = FORMATS[type(options)].read(files, options)
    domain: Domain = "crowd" if options.domain == "crowd" else "traffic"
    if domain == "crowd":
        sequences, _ = drop_absent(sequences)
    for sequence in sequences:
        find_faults(sequence, domain)
    identify(sequences, domain, options.agents)


def ngsim() -> bytes:
    """Two lanes of three vehicles in feet, as the portal writes them."""
    rows = [
        {
            "Vehicle_ID": n,
            "Frame_ID": k,
            "Total_Frames": 9,
            "Global_Time": 1113433135000 + 100 * k,
            "Local_X": 5.0,
            "Local_Y": 60.0 * n + 4 * k,
            "Global_X": 0.0,
            "Global_Y": 0.0,
            "v_Length": 15.0,
            "v_Width": 6.0,
            "v_Class": 2,
            "v_Vel": 40.0,
            "v_Acc": 0.0,
            "Lane_ID": 1 + n % 2,
            "Preceding": 0,
            "Following": 0,
            "Space_Headway": 0.0,
            "Time_Headway": 0.0,
            "Location": "i-80",
        }
        for n in range(6)
        for k in range(1, 9)
    ]
    return str(pd.DataFrame(rows).to_csv(index=False)).encode()


def highd(folder: Path) -> bytes:
    """Tracks; what is known of them is written to the folder."""
    rows = [
        {
            "frame": k,
            "id": n,
            "x": 30.0 * n + k,
            "width": 4.5,
            "height": 2.0,
            "xVelocity": 25.0,
            "laneId": 2,
        }
        for n in range(3)
        for k in range(1, 30)
    ]
    meta = pd.DataFrame({"id": range(3), "class": "Car", "drivingDirection": 2})
    folder.mkdir()
    (folder / f"01{RECORDING_META}").write_text("id,frameRate,speedLimit\n1,25,-1\n")
    tracks = str(pd.DataFrame(rows).to_csv(index=False)).encode()
    whole = str(meta.to_csv(index=False)).encode()
    (folder / f"01{TRACKS}").write_bytes(tracks)
    (folder / f"01{TRACKS_META}").write_bytes(whole)
    return tracks


def read_highd(path: Path) -> None:
    """A recording, of which the path is one of the three tables."""
    files = {end: path.with_name(f"01{end}") for end in (TRACKS, TRACKS_META, RECORDING_META)}
    read_all(HighDOptions(path=str(files[TRACKS]), min_samples=2, dt=0.2), files)


def sumo() -> list[bytes]:
    """Three vehicles of one lane, plain and packed."""
    moments = [
        f'<timestep time="{0.5 * k}">'
        + "".join(
            f'\n<vehicle id="{name}" lane="e_0" pos="{start + 5 * k}" speed="10" type="car"/>'
            for name, start in (("a", 0.0), ("b", 30.0), ("c", 70.0))
        )
        + "\n</timestep>"
        for k in range(6)
    ]
    text = '<?xml version="1.0" encoding="UTF-8"?>\n<fcd-export>\n{}\n</fcd-export>\n'
    plain = text.format("\n".join(moments)).encode()
    return [plain, gzip.compress(plain)]


def walkway(folder: Path) -> bytes:
    """A database of JuPedSim."""
    path = folder / "seed.sqlite"
    with closing(sqlite3.connect(path)) as base:
        base.executescript(
            "CREATE TABLE trajectory_data (frame, id, pos_x, pos_y, ori_x, ori_y);"
            "CREATE TABLE metadata (key TEXT PRIMARY KEY, value TEXT);"
            "CREATE TABLE geometry (hash INTEGER, wkt TEXT);"
            "INSERT INTO metadata VALUES ('version', '2'), ('fps', '10.0');"
        )
        rows = [(k, n, 1 + 0.12 * k, 1.0 * n, 1.0, 0.0) for k in range(21) for n in (1, 2)]
        base.executemany("INSERT INTO trajectory_data VALUES (?, ?, ?, ?, ?, ?)", rows)
        base.execute("INSERT INTO geometry VALUES (1, ?)", (ROOM,))
        base.commit()
    content = path.read_bytes()
    path.unlink()
    return content


def flat_platoons() -> bytes:
    """Platoons as one row per vehicle and time."""
    rows = [
        {"run": "r", "position": p, "t": round(0.1 * k, 1), "v": 10, "gap": 15, "make": f"m{p}"}
        for p in (1, 2, 3)
        for k in range(60)
    ]
    return str(pd.DataFrame(rows).to_csv(index=False)).encode()


def read_frame(path: Path) -> None:
    """As a notebook gives it; what pickle makes of it is the campaign's own."""
    Sequences.of(pickle.loads(path.read_bytes()))
