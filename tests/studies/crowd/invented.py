"""Synthetic results of the crowd study's tasks, for which the page's numbers are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nnode.data.sequence import Sequence
from nnode.data.store import Store, write_store
from studies.crowd.data import parts
from studies.crowd.tasks import new_system, row_of, silence
from studies.stores import sequences
from tests.studies.crowd.corridor import DT, sequence

#: A, k, kappa of each horizon (s); those of 2 s are the printed ones times 1.1, 0.9 and 1.2.
FORCE = {1: [0.5, 30.0, 10.0], 2: [1.1 * 0.0044, 0.9 * 34.9539, 1.2 * 9.8894]}
#: Costs, m² s; NN is worse than SF in one block of time.
COST = {"sf": 2.0, "nn": 1.0, "wall": 1.9}
SIMPLE = {"relaxation": 4.0, "constant_velocity": 5.0, "even_pace": 0.5, "printed": 3.0}
BAD_BLOCK, NN_THERE = "fold-1", 2.1
#: Costs in two other runs.
ELSEWHERE = {
    "run-a": {"sf": 2.0, "nn": 1.0, "wall": 5.0},
    "run-b": {"sf": 2.0, "nn": 3.0, "wall": 5.0},
}
#: Number of random starts; later starts begin at the network of the walls.
RESTARTS = 2
#: Relative increase of the cost from one start to the next.
WORSE = 0.1


def store(options: Any, folder: Path, kind: str, horizon: float) -> Store:
    """A sequence of 12 people in every second of 24 s; or two other runs of one sequence each."""
    rng = np.random.default_rng(5)
    samples = round(horizon / DT) + 1
    if kind == "others":
        items = [
            replace(sequence(rng, 0, samples, 6), recording=name, name=f"{name}/000")
            for name in ELSEWHERE
        ]
    else:
        items = [_paced(sequence(rng, number, samples, 12)) for number in range(24)]
    files = {"a": {"name": "a.txt", "sha256": "34cd"}}
    return write_store(
        folder / f"{kind}-{horizon:g}s", items, {"dt": DT, "files": files, "counts": {"dropped": 3}}
    )


def _paced(s: Sequence) -> Sequence:
    """The same people at different speeds with a mean of about 1 m/s."""
    pace = np.linspace(0.8, 1.2, s.n_agents)[:, None]
    return replace(s, x=s.x[:1] + pace * (s.x - s.x[:1]))


def _horizon(folder: str) -> int:
    return int(folder[-2])


def fit(
    kind: str,
    folder: str,
    scope: str,
    folds: int,
    span: list[float],
    seed: int,
    start: list[float] | None,
    steps: int,
) -> dict[str, Any]:
    """In place of :func:`studies.crowd.tasks.fit`."""
    horizon = _horizon(folder)
    drawn = seed < RESTARTS
    assert (start is None) == (drawn and horizon == 1), (
        "longer horizons start at the fits of shorter ones"
    )
    system = new_system("sf" if kind == "sf" else "nn", seed)
    if kind == "wall":
        silence(system)
    row = FORCE[horizon] if kind == "sf" else row_of(system.requires_grad_()).tolist()
    if start is not None and kind != "sf":
        assert row == start or not drawn
        row = start
    items = sequences(folder)
    train, held = parts(folder, scope, folds, (span[0], span[1]))
    cost = COST[kind] * (1 + WORSE * seed)
    unseen = NN_THERE if (kind, scope) == ("nn", BAD_BLOCK) else cost
    return {
        "row": row,
        "J": cost,
        "evaluations": 7,
        "train": {items[i].name: cost for i in train},
        "heldout": {items[i].name: unseen for i in held},
    }


def resample(
    folder: str, row: list[float], draws: int, first: int, last: int, **options: Any
) -> Any:
    """In place of :func:`studies.crowd.tasks.resample`: 0.5 to 1.5 times the row."""
    factors = np.linspace(0.5, 1.5, draws)[first:last]
    return {"rows": [[factor * value for value in row] for factor in factors]}


def baselines(folder: str) -> dict[str, Any]:
    """In place of :func:`studies.crowd.tasks.baselines`."""
    names = [s.name for s in sequences(folder)]
    return {"costs": {model: dict.fromkeys(names, cost) for model, cost in SIMPLE.items()}}


def transfer(folder: str, rows: dict[str, list[float]]) -> dict[str, Any]:
    """In place of :func:`studies.crowd.tasks.transfer`."""
    assert rows["sf"] == FORCE[_horizon(folder)]
    return {
        "runs": {
            run: {model: {"a": cost} for model, cost in {**costs, **SIMPLE}.items()}
            for run, costs in ELSEWHERE.items()
        }
    }
