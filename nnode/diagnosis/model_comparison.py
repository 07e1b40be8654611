"""Comparison of models on the confirmation clusters.

The test of presence is a one-sided score test by sign flips of clusters: it asks whether the
whitened residuals of the model without the effect correlate with the effect's predicted change. Its
p-value is combined with that of the exploration clusters
(:mod:`nnode.diagnosis.statistics.combination`). A significant improvement of predictions is a
stricter question: it needs an effect of more than half the strength that was estimated in the
exploration clusters, and its standardised distance is half that of the score test. Therefore the
sum of squared residuals and the mean square error of positions only have to fall. With several
effects, one is confirmed if the full model passes against the model without it and without it and
any subset of the others. This closed testing keeps the familywise error rate, and a weak effect is
tested given the strong ones.

Sources: Rao 1948 (scores); Marcus, Peritz & Gabriel 1976 (closed tests).
"""

from __future__ import annotations

import numpy as np

from nnode.calibrate.parameters import ParameterVector
from nnode.data.clusters import group_sums
from nnode.data.sequence import Sequence
from nnode.diagnosis.crowds.engine import CrowdEngine
from nnode.diagnosis.lanes.engine import TrafficEngine
from nnode.diagnosis.lanes.followers import FollowersEngine
from nnode.diagnosis.outcome import Simulation
from nnode.diagnosis.residuals.engine import AgentsEngine, Engine
from nnode.diagnosis.statistics.combination import least_confirmation
from nnode.diagnosis.statistics.paired import score_toward
from nnode.model.system import System


def engine_of(
    system: System,
    sequences: list[Sequence],
    clusters: np.ndarray | None = None,
    *,
    whole: bool = False,
    differ: bool = False,
    apart: float = 0.0,
    like: Engine | None = None,
) -> Engine:
    """The engine for a model and its extensions.

    Args:
        whole: compare whole lane sequences with unweighted errors, as most calibrations do; it has
            no effect in crowds.
        differ: whether drivers differ. apart: smallest time between their positions, s.
        like: an engine whose variances are used if drivers differ.
    """
    if whole and system.domain == "traffic":
        return TrafficEngine(sequences, np.inf, clusters, np.inf)
    if isinstance(like, FollowersEngine):
        return FollowersEngine(sequences, clusters, like=like)
    if differ:
        return FollowersEngine(sequences, clusters, apart=apart)
    return windows_of(system, sequences, clusters)


def windows_of(
    system: System, sequences: list[Sequence], clusters: np.ndarray | None = None
) -> Engine:
    """The engine for any models of one domain, also those that are code."""
    if system.domain == "crowd":
        return CrowdEngine(sequences, clusters=clusters, given=system)
    return TrafficEngine(sequences, clusters=clusters)


class ModelComparison:
    """Compares models on some sequences.

    Args:
        engine: of these sequences.
        base: the model to whose residuals the whitening is fitted.
    """

    def __init__(self, engine: Engine, base: System) -> None:
        self._engine = engine
        self._engine.fit_whitening(base, ParameterVector(base).row)
        #: the engine of the errors that are reported
        self._reported = self._engine
        if not isinstance(self._engine, AgentsEngine):
            self._reported = engine_of(base, engine.sequences, whole=True)

    @property
    def agents_differ(self) -> bool:
        """Whether agents differ in the residuals. Then errors of positions are mostly due to
        autocorrelated pushes and are no criterion."""
        return isinstance(self._engine, AgentsEngine)

    @property
    def followers(self) -> bool:
        """Whether errors are those of followers one by one."""
        return isinstance(self._engine, FollowersEngine)

    @property
    def floor(self) -> float:
        """Mean square error of positions due to measurement noise, m²."""
        return self._engine.noise_floor()

    def squares(self, system: System) -> np.ndarray:
        """``(S,)`` mean square errors of positions, m²; NaN for sequences that are too short."""
        means = self._reported.squares(system, ParameterVector(system).row).means()
        # sequences at the end may be too short to be compared
        missing = len(self._reported.names) - len(means)
        return np.pad(means, (0, missing), constant_values=np.nan)

    def simulated(self, system: System) -> list[Simulation | None]:
        """The simulations whose errors are :meth:`squares`."""
        return self._reported.simulated(system, ParameterVector(system).row)

    def scores(self, system: System) -> np.ndarray:
        """``(G,)`` sums of squared (Huber) residuals of the clusters: twice the negative logarithm
        of the predictive likelihood, up to a constant."""
        return group_sums(self._residuals(system) ** 2, self._engine.cluster)

    def _residuals(self, system: System) -> np.ndarray:
        residuals = self._engine.residuals(system, ParameterVector(system).row[None])[0].numpy()
        return np.nan_to_num(residuals, nan=np.inf)

    def score_toward(self, before: System, after: System) -> np.ndarray:
        """``(G,)`` by cluster, see :func:`~nnode.diagnosis.statistics.paired.score_toward`."""
        residuals_before, residuals_after = self._residuals(before), self._residuals(after)
        return score_toward(residuals_before, residuals_after, self._engine.cluster)


def too_few(clusters: int) -> str:
    """Why this number of confirmation clusters cannot confirm anything; empty if it can."""
    required = least_confirmation()
    if clusters >= required:
        return ""
    return (
        f"{clusters} confirmation clusters are independent of the exploration clusters, and a "
        f"confirmation requires {required}"
    )
