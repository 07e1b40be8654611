"""Tables that tests make up, as files, what the readers make of them, and entries of an index."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from hypothesis import strategies as st
from scipy.io import savemat

from nnode.data.cut import Reading
from nnode.data.options import DataOptions
from nnode.data.prepare import FORMATS


def entry(start: float, end: float, *agents: str, recording: str = "r") -> dict[str, Any]:
    """What clusters and splits know of a sequence."""
    return {
        "name": f"{recording}/{start:g}",
        "recording": recording,
        "start": start,
        "end": end,
        "agents": list(agents),
    }


def tidy(
    samples: int, agents: int, sequences: Iterable[str] = "s", step: float = 1.0
) -> pd.DataFrame:
    """Agents 30 m apart who move ``step`` m in each 0.1 s, by sequence, agent and time."""
    parts = [
        pd.DataFrame(
            {
                "sequence": sequence,
                "time": 0.1 * np.arange(samples),
                "agent": agent,
                "x": 30.0 * agent + step * np.arange(samples),
            }
        )
        for sequence in sequences
        for agent in range(agents)
    ]
    return pd.concat(parts, ignore_index=True)


def saved(path: Path, *tables: pd.DataFrame) -> Path:
    """Tables one below the other, as Parquet where the file's name says so, else as CSV."""
    path.parent.mkdir(parents=True, exist_ok=True)
    table = pd.concat(tables)
    if path.suffix == ".parquet":
        table.to_parquet(path)
    else:
        table.to_csv(path, index=False)
    return path


def esimas(path: Path, *platoons: tuple[np.ndarray, np.ndarray], packed: bool = False) -> Path:
    """Positions ``(cars, K)`` and times ``(K,)`` of platoons, in the layout of ESIMAS."""
    cells = np.empty((len(platoons), 1), dtype=object)
    for i, (x, time) in enumerate(platoons):
        cells[i, 0] = {"Xarr": x, "Tarr": time}
    savemat(path, {"sequences": cells}, do_compression=packed)
    return path


def read(kind: type[DataOptions], path: Path, /, **options: object) -> Reading:
    """The sequences that the reader of some options makes of a file."""
    made = kind(path=str(path), **options)  # type: ignore[call-arg, arg-type]
    return FORMATS[kind].sequences(FORMATS[kind].files(made), made)


def damaged(data: st.DataObject, sound: bytes, start: int, most: int) -> bytes:
    """A file of which up to ``most`` bytes behind ``start`` are others, and whose end may lack."""
    whole = bytearray(sound)
    at = data.draw(st.integers(start, len(whole) - 1))
    size = data.draw(st.integers(0, most))
    whole[at : at + size] = data.draw(st.binary(min_size=size, max_size=size))
    return bytes(whole[: data.draw(st.integers(at, len(whole)))])
