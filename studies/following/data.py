"""The three sources of pairs: prepared once, read by every task, folds by cluster."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from nnode.data.clusters import clusters, index_of
from nnode.data.options import Faults
from nnode.data.prepare import prepare
from nnode.data.readers.openacc import OpenAccOptions
from nnode.data.readers.pairs import PairOptions
from nnode.data.sequence import Batch, Sequence, collate
from nnode.data.split import TEST, TRAIN
from nnode.data.store import Store
from nnode.errors import ConfigError
from studies.options import FollowingStudyOptions
from studies.stores import sequences

#: Names of the prepared stores.
PAIRS, PLATOONS, LEADERS = "pairs", "platoons", "leaders"


def stores(options: FollowingStudyOptions, folder: Path) -> dict[str, Store]:
    """Prepare the sources, by name.

    Raises:
        ConfigError: no folder with the raw files.
        DataError: recordings that cannot be read.
    """
    if options.source is None:
        raise ConfigError(
            "study.source is not set; expected a folder with ngsim_pairs, openacc and tgsim, "
            "whose files have no addresses of their own (NNODE_DATA in the environment sets it)"
        )
    chosen = {
        PAIRS: PairOptions(
            name="ngsim_pairs", path="ngsim_pairs", files=["*.parquet"], columns={"time": "t"}
        ),
        PLATOONS: OpenAccOptions(name="astazero", path="openacc/astazero.parquet"),
        LEADERS: PairOptions(
            name="tgsim",
            path="tgsim",
            files=["*.parquet"],
            columns={
                "time": "timestamp",
                "x_follower": "xFollowerReal",
                "v_follower": "vFollowerReal",
                "x_leader": "xLeaderReal",
                "v_leader": "vLeaderReal",
                "follower": "follower_id",
                "leader": "leader_id",
                "run": "run_no",
            },
            constant={"follower_kind": "HV"},
        ),
    }
    return {
        name: prepare(
            replace(source, source=options.source, faults=Faults.drop), folder / "data" / name
        )
        for name, source in chosen.items()
    }


def pairs(folder: str, test: bool = False) -> tuple[Sequence, ...]:
    """The pairs of one side of the published division."""
    return tuple(s for s in sequences(folder) if s.split == (TEST if test else TRAIN))


@lru_cache(maxsize=4)
def batch(folder: str, test: bool = False) -> Batch:
    """Those pairs, side by side."""
    return collate(pairs(folder, test))


def labels(items: Iterable[Sequence]) -> np.ndarray:
    """``(B,)`` the cluster of each sequence: those that share a vehicle."""
    return clusters(index_of(items))


def behind(platoon: Sequence) -> list[Sequence]:
    """Every follower of a platoon with the vehicle ahead of it, foremost pair first.

    The vehicle ahead is where its measured speed brings it, and the follower its measured gap
    further back, as the published calibrations have it: over a quarter of an hour gaps and
    speeds of one vehicle differ by metres.
    """
    followers = []
    for i in reversed(range(platoon.n_agents - 1)):
        keep = np.zeros(platoon.n_agents, dtype=bool)
        keep[[i, i + 1]] = True
        pair = platoon.select(keep)
        v = pair.velocity()[:, 1]
        lead = np.concatenate([v[:1] * 0, np.cumsum((v[1:] + v[:-1]) / 2 * pair.dt, axis=0)])
        x = np.stack([lead - (pair.x[:, 1] - pair.x[:, 0]), lead], 1)
        followers.append(replace(pair, name=f"{platoon.name}/{pair.agents[0]}", x=x))
    return followers


def gap_of(pair: Sequence) -> np.ndarray:
    """``(K,)`` gap of a pair from bumper to bumper, m; lengths that are not known count as 0."""
    length = np.nan_to_num(np.zeros(2) if pair.length is None else pair.length)
    return np.asarray(pair.x[:, 1, 0] - pair.x[:, 0, 0] - length[1])
