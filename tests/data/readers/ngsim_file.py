"""Generated files in the layout of NGSIM's public trajectories."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

FOOT = 0.3048

#: ms since 1970 at frame 0 of the real periods of both freeways.
PERIODS = {
    ("i-80", "1600"): 1113433134900,
    ("i-80", "1700"): 1113436766900,
    ("us-101", "0750"): 1118846978900,
    ("us-101", "0805"): 1118847842000,
}

#: The columns of the portal's file.
COLUMNS = [
    *("Vehicle_ID", "Frame_ID", "Total_Frames", "Global_Time"),
    *("Local_X", "Local_Y", "Global_X", "Global_Y"),
    *("v_length", "v_Width", "v_Class", "v_Vel", "v_Acc", "Lane_ID"),
    *("O_Zone", "D_Zone", "Int_ID", "Section_ID", "Direction", "Movement"),
    *("Preceding", "Following", "Space_Headway", "Time_Headway", "Location"),
]
STREET = COLUMNS[14:20]


def period(
    location: str,
    called: str,
    *,
    cars: int = 5,
    lanes: int = 2,
    seconds: float = 40.0,
    seed: int = 0,
    noise: float = 0.0,
) -> pd.DataFrame:
    """A period's rows: platoons at about 10 m/s in every lane, vehicles numbered from 1.

    ``noise`` (m) is the standard deviation of errors of the positions; speeds are the true ones.
    """
    rng = np.random.default_rng(seed)
    frames = np.arange(1, round(seconds * 10) + 1)
    time = frames / 10
    parts = []
    for lane in range(1, lanes + 1):
        for place in range(cars):
            number = cars * (lane - 1) + place + 1
            deviation = 2 * np.sin(2 * np.pi * (time / 15 - 0.1 * place + rng.uniform(0, 0.1)))
            speed = 10 + deviation
            x = 30.0 * (cars - place) + np.cumsum(speed) / 10
            parts.append(
                {
                    "Vehicle_ID": number,
                    "Frame_ID": frames,
                    "Total_Frames": len(frames),
                    "Global_Time": PERIODS[location, called] + 100 * frames,
                    "Local_X": 12.0 * lane - 6,
                    "Local_Y": (x + noise * rng.standard_normal(len(x))) / FOOT,
                    "Global_X": 6042842.116,
                    "Global_Y": 2133117.662,
                    "v_length": 15.0,
                    "v_Width": 6.0,
                    "v_Class": 3 if place == 2 else 2,
                    "v_Vel": speed / FOOT,
                    "v_Acc": np.gradient(speed, 0.1) / FOOT,
                    "Lane_ID": lane,
                    **dict.fromkeys(STREET, np.nan),
                    "Preceding": number - 1 if place else 0,
                    "Following": number + 1 if place < cars - 1 else 0,
                    "Space_Headway": 30 / FOOT if place else 0,
                    "Time_Headway": 3.0 if place else 9999.99,
                    "Location": location,
                }
            )
    table = pd.concat([pd.DataFrame(part) for part in parts])
    table = table.round({"Local_Y": 3, "v_Vel": 2, "v_Acc": 2, "Space_Headway": 2})
    return table.sort_values(["Vehicle_ID", "Frame_ID"])[COLUMNS]


def published(path: Path, *periods: pd.DataFrame) -> Path:
    """Write the portal's file: the rows of all periods in random order, with column names."""
    table = pd.concat(periods).sample(frac=1.0, random_state=0)
    table.to_csv(path, index=False)
    return path


def quarter(path: Path, table: pd.DataFrame) -> Path:
    """Write an older file of one period, without column names and location.

    The separator is a comma in a ``.csv`` file and a blank in others.
    """
    table = table.drop(columns=[*STREET, "Location"])
    table.to_csv(path, index=False, header=False, sep="," if path.suffix == ".csv" else " ")
    return path
