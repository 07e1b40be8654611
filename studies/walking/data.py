"""Two-way flows of two experiments, cut into sequences whose people walked there before."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from nnode.data.readers.juelich import Velocity
from nnode.data.sequence import Batch, Sequence, collate
from nnode.data.store import Store
from studies.crowd.data import OTHERS, RECORDING, prepared
from studies.options import StudyOptions
from studies.stores import sequences

#: Recordings of both experiments; frame rates differ, so that they are two batches.
RUNS = {"main": (RECORDING,), "others": OTHERS}
#: s before a sequence in which preferred velocities are measured.
HISTORY = 1.0


def prepare_runs(options: StudyOptions, folder: Path, kind: str, horizon: float) -> Store:
    """The recordings of one experiment as sequences of ``horizon`` seconds.

    Velocities at the start are backward differences, so that nothing of what is predicted is in
    them. Sequences of one person, and the first one of a recording, which nothing went before,
    are left out by :func:`measured_before`.
    """
    more = {"history": HISTORY, "velocity": Velocity.backward, "min_agents": 2}
    return prepared(options, folder, kind, horizon, **more)


def measured_before(folder: str) -> list[Sequence]:
    """The sequences of a prepared folder before which somebody was measured."""
    return [s for s in sequences(folder) if s.preferred is not None]


def chosen(folders: Iterable[str], held: Iterable[str], *, test: bool) -> list[Batch]:
    """The sequences of some runs, or of all others, as one batch of each experiment."""
    batches, runs = [], set(held)
    for folder in folders:
        mine = [s for s in measured_before(folder) if (s.recording in runs) == test]
        if mine:
            batch = collate(mine)
            assert batch.preferred is not None
            # people who were not measured before are there for the others, but nothing is
            # asked of them
            known = batch.preferred.isfinite().all(-1)
            batches.append(replace(batch, valid=batch.valid & known))
    return batches
