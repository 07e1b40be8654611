"""Both benchmarks in their own conventions."""

from __future__ import annotations

from pathlib import Path

from nnode.data.options import DataOptions
from nnode.data.prepare import prepare
from nnode.data.readers.juelich import Velocity
from nnode.data.readers.jupedsim import WalkwayOptions
from nnode.data.readers.pairs import PairOptions
from nnode.data.store import Store

#: Scenes of the benchmark of prediction in the open.
SCENES = ("eth_univ", "eth_hotel", "ucy_univ", "ucy_zara01", "ucy_zara02")
#: s between two samples; samples that are seen, and samples that are predicted from them.
STEP, SEEN, AHEAD = 0.4, 8, 12


def events(source: str) -> PairOptions:
    """People who follow automated cars, with the published division."""
    return PairOptions(
        name="waymo_pairs",
        source=source,
        path="waymo_pairs",
        files=["*.parquet"],
        columns={"time": "t", "run": "split", "pair": "event"},
    )


def scene(name: str, source: str) -> WalkwayOptions:
    """A scene in windows of what is predicted; everybody was seen before, on average as fast as
    his ``preferred`` velocity says."""
    return WalkwayOptions(
        name=name,
        source=source,
        path=f"eth_ucy/{name}.parquet",
        columns={"agent": "id", "time": "frame"},
        time_unit="frame",
        frame_rate=1 / STEP,
        t_seq=AHEAD * STEP,
        history=(SEEN - 1) * STEP,
        velocity=Velocity.backward,
    )


def stores(source: str, folder: Path) -> dict[str, Store]:
    """Prepared data of the pairs and of every scene.

    Raises:
        DataError: files that are not there or cannot be read.
    """
    chosen: dict[str, DataOptions] = {"waymo_pairs": events(source)}
    chosen |= {name: scene(name, source) for name in SCENES}
    return {name: prepare(options, folder / name) for name, options in chosen.items()}
