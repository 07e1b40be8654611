"""Generated tables as files, the readers' results, and entries of a store's index."""

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
    """An entry of a store's index, as clusters and splits use it."""
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
    """Agents 30 m apart who move ``step`` m in each 0.1 s, sorted by sequence, agent and time."""
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
    """Write the concatenated tables as Parquet or CSV, by the suffix of the path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    table = pd.concat(tables)
    if path.suffix == ".parquet":
        table.to_parquet(path)
    else:
        table.to_csv(path, index=False)
    return path


def esimas(path: Path, *platoons: tuple[np.ndarray, np.ndarray], packed: bool = False) -> Path:
    """Write positions ``(cars, K)`` and times ``(K,)`` of platoons in the layout of ESIMAS."""
    cells = np.empty((len(platoons), 1), dtype=object)
    for i, (x, time) in enumerate(platoons):
        cells[i, 0] = {"Xarr": x, "Tarr": time}
    savemat(path, {"sequences": cells}, do_compression=packed)
    return path


def read(kind: type[DataOptions], path: Path, /, **options: object) -> Reading:
    """Read a file by the reader that belongs to a class of options."""
    reader_options = kind(path=str(path), **options)  # type: ignore[call-arg, arg-type]
    return FORMATS[kind].sequences(FORMATS[kind].files(reader_options), reader_options)


def damaged(data: st.DataObject, content: bytes, start: int, max_size: int) -> bytes:
    """Content with up to ``max_size`` bytes from ``start`` on replaced, and possibly cut short."""
    result = bytearray(content)
    at = data.draw(st.integers(start, len(result) - 1))
    size = data.draw(st.integers(0, max_size))
    result[at : at + size] = data.draw(st.binary(min_size=size, max_size=size))
    return bytes(result[: data.draw(st.integers(at, len(result)))])
