"""The results of the tasks, as the page needs them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from nnode.calibrate.problem import ResidualProblem
from nnode.calibrate.resampling import DRAWS, Paired, group_weights, paired
from nnode.data.sequence import Sequence, collate
from nnode.data.store import Store
from nnode.model.system import System
from nnode.simulation.fused import FusedSolver
from studies.following import data
from studies.following.candidates import EVERY, REFERENCE, key
from studies.options import FollowingStudyOptions


@dataclass
class Study:
    """Options, prepared data, and results of tasks by key."""

    options: FollowingStudyOptions
    stores: dict[str, Store]
    found: dict[str, dict[str, Any]]

    def one(self, kind: str, name: str) -> dict[str, Any]:
        """The result of a task of a candidate."""
        return self.found[f"{kind}-{key(name)}"]

    @property
    def names(self) -> list[str]:
        """Candidates that were cross-validated."""
        return [name for name in EVERY if f"cv-{key(name)}" in self.found]

    @property
    def best(self) -> str:
        """The candidate of the least cross-validated error: no test pair has a say in it."""
        return min(self.names, key=lambda name: float(np.mean(self.heldout(name))))

    def heldout(self, name: str, objective: str = "spacing") -> np.ndarray:
        """Cross-validated costs of the training pairs."""
        return np.array(self.one("cv", name)["heldout"][objective])

    def tested(self, name: str, objective: str = "spacing") -> np.ndarray:
        """Costs of the test pairs."""
        return np.array(self.one("test", name)[objective])

    @property
    def clusters(self) -> np.ndarray:
        """Of the training pairs."""
        return np.array(self.one("cv", REFERENCE)["clusters"])

    def against_reference(self, name: str, by_pair: bool = False) -> Paired:
        """A candidate minus the reference on held-out training pairs, clusters resampled."""
        group = np.arange(len(self.clusters)) if by_pair else self.clusters
        return _paired(self.heldout(name), self.heldout(REFERENCE), group, self.options.seed)

    def test_against(self, name: str) -> Paired:
        """A candidate minus the reference on the test pairs, pairs resampled."""
        values = self.tested(name)
        return _paired(values, self.tested(REFERENCE), np.arange(len(values)), self.options.seed)

    def pairs(self, test: bool = False) -> tuple[Sequence, ...]:
        """Of one side of the published division."""
        return data.pairs(str(self.stores[data.PAIRS].folder), test)

    @property
    def shared(self) -> int:
        """How many test pairs share a vehicle with a training pair."""
        train, test = self.pairs(), self.pairs(test=True)
        label = data.labels((*train, *test))
        return int(np.isin(label[len(train) :], label[: len(train)]).sum())

    def system(self, name: str) -> System:
        """A candidate with its parameters from all training pairs."""
        system = EVERY[name].system()
        vector = ResidualProblem(system, collate(self.pairs()[:1]), FusedSolver()).vector
        return vector.fill_(np.array(self.one("cv", name)["row"]))


def _paired(first: np.ndarray, second: np.ndarray, group: np.ndarray, seed: int) -> Paired:
    """A comparison in which a candidate may have blown up on a pair: then it has no interval."""
    if np.isfinite(first).all():
        return paired(first, second, group, seed)
    return Paired(math.inf, math.nan, math.nan, math.nan, float((first < second).mean()))


def interval(values: np.ndarray, group: np.ndarray, seed: int) -> tuple[float, float]:
    """95 % percentile interval of a mean, groups resampled; NaN where a value is infinite."""
    if not np.isfinite(values).all():
        return math.nan, math.nan
    rng = np.random.default_rng(seed)
    low, high = np.quantile(group_weights(group, DRAWS, rng) @ values, [0.025, 0.975])
    return float(low), float(high)
