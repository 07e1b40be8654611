"""Two-way flows of two experiments, cut into sequences whose people walked there before."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from nnode.data.prepare import prepare
from nnode.data.readers.juelich import Velocity
from nnode.data.sequence import Batch, Sequence, collate
from nnode.data.store import Store
from studies.crowd.data import OTHERS, RECORDING, corridor

#: Recordings of both experiments; frame rates differ, so that they are two batches.
RUNS = {"main": (RECORDING,), "others": OTHERS}
#: s before a sequence in which preferred velocities are measured.
HISTORY = 1.0


def prepare_runs(
    kind: str, source: str | None, download: str | None, horizon: float, folder: Path
) -> Store:
    """The recordings of one experiment as sequences of ``horizon`` seconds.

    Velocities at the start are backward differences, so that nothing of what is predicted is in
    them. Sequences of one person, and the first one of a recording, which nothing went before,
    are left out by :func:`sequences`.
    """
    options = corridor(
        kind != "main",
        source=source,
        download=download,
        t_seq=horizon,
        history=HISTORY,
        velocity=Velocity.backward,
        min_agents=2,
    )
    return prepare(options, folder)


@lru_cache(maxsize=8)
def sequences(folder: str) -> tuple[Sequence, ...]:
    """Those of a prepared folder before which somebody was measured."""
    return tuple(s for s in Store(folder) if s.preferred is not None)


def chosen(folders: Iterable[str], held: Iterable[str], *, test: bool) -> list[Batch]:
    """The sequences of some runs, or of all others, as one batch of each experiment."""
    found, runs = [], set(held)
    for folder in folders:
        mine = [s for s in sequences(folder) if (s.recording in runs) == test]
        if mine:
            batch = collate(mine)
            assert batch.preferred is not None
            # people who were not measured before are there for the others, but nothing is
            # asked of them
            known = batch.preferred.isfinite().all(-1)
            found.append(replace(batch, valid=batch.valid & known))
    return found
