"""Reader of the preprocessed ESIMAS sequences: cars on the middle lane of a motorway tunnel.

A file holds a MATLAB cell array ``sequences`` of structs ``Xarr`` (cars x K positions, m) and
``Tarr`` (K times, s). Two families are published: sequences with three or more cars
(``sequence_data1-1_1.mat``) and with two or more (``sequence_data_1-1_1.mat``).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from nnode.data.cut import Reading, by_sequence
from nnode.data.options import DataOptions
from nnode.data.readers.matlab import read_matlab
from nnode.data.readers.recordings import natural, raw_files
from nnode.data.trajectories import Trajectories
from nnode.errors import ConfigError, DataError

#: Start of a file's name, by the least number of cars of the family's sequences.
PREFIX = {2: "sequence_data_", 3: "sequence_data"}

_NAME = {
    2: re.compile(r"sequence_data_(.+)\.mat"),
    3: re.compile(r"sequence_data(?!_)(.+)\.mat"),
}


@dataclass
class EsimasOptions(DataOptions):
    """The preprocessed ESIMAS sequences (.mat)."""

    published: ClassVar[bool] = True

    name: str = "esimas"
    domain: str = "traffic"
    fill: float = 0.0  # the published sequences as they are
    min_vehicles: int = 3  # 2 or 3: which of the two published families


def esimas_files(options: EsimasOptions) -> dict[str, Path]:
    """Path of each wanted recording's file, see :func:`nnode.data.readers.recordings.raw_files`.

    Raises:
        ConfigError: no such family, or an unknown recording.
    """
    family = options.min_vehicles
    if family not in PREFIX:
        raise ConfigError(
            f"data.min_vehicles={family}: two families are published, expected one of "
            f"{', '.join(map(str, PREFIX))}"
        )
    return raw_files(
        options,
        default="esimas",
        pattern=_NAME[family],
        file_name=lambda recording: f"{PREFIX[family]}{recording}.mat",
    )


def read_esimas(path: Path, options: EsimasOptions | None = None) -> Reading:
    """Read one file.

    Args:
        path: a file whose name is ``sequence_data`` or ``sequence_data_``, the recording, and
            ``.mat``.
        options: ``fill`` and ``smooth`` are read.

    Returns:
        The sequences in the order of the file, cars in the order of its rows, named
        ``recording/000``, ``recording/001``, ... No agent identifiers: the source has none.

    Raises:
        DataError: a name of another pattern; no MATLAB file, a truncated one, or one with
            another content; names the sequence and the field.

    Source: E. Kallo, A. Fazekas, S. Lamberty, M. Oeser, "Microscopic traffic data obtained
    from videos recorded on a German motorway", Mendeley Data V1, 2019.
    """
    path = Path(path)
    match = re.fullmatch(r"sequence_data_?(.+)\.mat", path.name)
    if match is None:
        raise DataError(f"{path}: expected a file name like sequence_data1-1_1.mat")
    recording = match.group(1)
    cells = _load(path)
    if not cells:
        raise DataError(f"{path}: 'sequences' is empty; expected at least one sequence")
    columns: dict[str, list[np.ndarray]] = {"sequence": [], "agent": [], "time": [], "x": []}
    for number, cell in enumerate(cells):
        where = f"{path}, sequence {number}"
        x = _field(cell, "Xarr", where)
        time = _field(cell, "Tarr", where).ravel()
        if x.ndim != 2 or x.shape[1] != time.size or x.size == 0:
            raise DataError(
                f"{where}: expected Xarr (cars, K) and Tarr (K), found {x.shape} and ({time.size},)"
            )
        cars, samples = x.shape
        columns["sequence"].append(np.full(x.size, f"{number:03d}", dtype=object))
        columns["agent"].append(np.repeat(np.arange(cars).astype(str).astype(object), samples))
        columns["time"].append(np.tile(time, cars))
        columns["x"].append(x.reshape(-1, 1))
    whole = {name: np.concatenate(parts) for name, parts in columns.items()}
    rows = Trajectories(
        path=path,
        name=recording,
        where=lambda i: f"sequence {whole['sequence'][i]}, car {whole['agent'][i]}",
        recording=np.full(len(whole["time"]), recording, dtype=object),
        **whole,
    )
    return by_sequence(rows, options or EsimasOptions(), natural, ordered=True, named=False)


def _load(path: Path) -> list[Any]:
    if not path.is_file():
        raise DataError(f"there is no file {path}")
    try:
        content = read_matlab(path)
    except (ValueError, OSError) as error:
        raise DataError(
            f"{path} cannot be read as a MATLAB file ({error}); it is truncated or of another "
            "format: fetch it again"
        ) from error
    if "sequences" not in content:
        raise DataError(
            f"{path}: expected a cell array 'sequences', found {', '.join(content) or 'nothing'}"
        )
    sequences = content["sequences"]
    if isinstance(sequences, np.ndarray):
        return list(sequences.ravel())
    return sequences if isinstance(sequences, list) else [sequences]


def _field(cell: Any, name: str, where: str) -> np.ndarray:
    """A struct's field as numbers."""
    while isinstance(cell, list) and len(cell) == 1:
        cell = cell[0]
    if not isinstance(cell, dict) or name not in cell:
        held = ", ".join(cell) if isinstance(cell, dict) else type(cell).__name__
        raise DataError(f"{where}: expected a struct with the fields Xarr and Tarr, found {held}")
    if not isinstance(cell[name], np.ndarray):
        raise DataError(f"{where}: {name} holds no plain numbers ({type(cell[name]).__name__})")
    return cell[name].astype(np.float64)
