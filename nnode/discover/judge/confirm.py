"""What the sealed clusters say, once: is what was found in the open ones true of them?

Tested is whether the effect is there: whether the whitened residuals of the model without it lean
the way that the effect bends its predictions, cluster by cluster, one-sided, by sign flips. That
takes at least five clusters at 5 %. Whether predictions improve is another question: that they do
so significantly asks for an effect of more than half the strength that the open clusters gave it,
and has half the standardized distance of this test. So the sums of squared residuals, and the mean
square error of positions, which the report shows, must fall, and no more. Of several effects one is
confirmed if the model with all of them passes beside that without it, and without it and any of the
others: so the level holds for all names together, and none drowns in what another one does.

Sources: Rao 1948 (scores); Marcus, Peritz & Gabriel 1976 (closed tests).
"""

from __future__ import annotations

import numpy as np

from nnode.calibrate.parameters import ParameterVector
from nnode.data.clusters import least_number
from nnode.data.sequence import Sequence
from nnode.discover.crowds.engine import CrowdEngine
from nnode.discover.found import Simulation
from nnode.discover.lanes.engine import TrafficEngine
from nnode.discover.lanes.followers import FollowersEngine
from nnode.discover.residuals.engine import Engine
from nnode.discover.residuals.fit import sums
from nnode.discover.rules import rules
from nnode.discover.statistics.paired import leaning
from nnode.model.system import System
from nnode.population.followers import drivers_differ


def engine_of(
    system: System,
    sequences: list[Sequence],
    clusters: np.ndarray | None = None,
    *,
    whole: bool = False,
    like: Engine | None = None,
) -> Engine:
    """The engine for a model and its extensions.

    Args:
        whole: compares whole sequences, all errors alike, as most calibrations do; people are
            compared as always.
        like: whose variances hold, where drivers differ.
    """
    if whole and system.domain == "traffic":
        return TrafficEngine(sequences, np.inf, clusters, np.inf)
    if isinstance(like, FollowersEngine):
        return FollowersEngine(sequences, clusters, like=like)
    if like is None and drivers_differ(system, sequences):
        return FollowersEngine(sequences, clusters)
    return windows_of(system, sequences, clusters)


def windows_of(
    system: System, sequences: list[Sequence], clusters: np.ndarray | None = None
) -> Engine:
    """The engine for models that have nothing in common but their domain, and for code."""
    if system.domain == "crowd":
        return CrowdEngine(sequences, clusters=clusters)
    return TrafficEngine(sequences, clusters=clusters)


class Comparing:
    """Models on some sequences.

    Args:
        engine: of these sequences.
        base: the model around which residuals are whitened and weighted.
    """

    def __init__(self, engine: Engine, base: System) -> None:
        self._windows = engine
        self._windows.settle(base, ParameterVector(base).row)
        #: whose errors are shown
        self._shown = self._windows
        if not isinstance(self._windows, FollowersEngine | CrowdEngine):
            self._shown = engine_of(base, engine.sequences, whole=True)

    @property
    def drivers(self) -> bool:
        """Whether drivers differ in the residuals: then errors of positions are mostly those of
        pushes that last, and tell little."""
        return isinstance(self._windows, FollowersEngine)

    @property
    def floor(self) -> float:
        """Mean square error of positions that is noise of the measurement, m²."""
        return self._windows.noise_floor()

    def squares(self, system: System) -> np.ndarray:
        """``(S,)`` mean square errors of positions, m²; NaN where nothing is compared."""
        found = self._shown.squares(system, ParameterVector(system).row).means()
        # the last ones may be too short to be compared
        missing = len(self._shown.names) - len(found)
        return np.pad(found, (0, missing), constant_values=np.nan)

    def simulated(self, system: System) -> list[Simulation | None]:
        """The simulations whose errors are :meth:`squares`."""
        return self._shown.simulated(system, ParameterVector(system).row)

    def scores(self, system: System) -> np.ndarray:
        """``(G,)`` sums of squared residuals of the clusters: but for a constant twice the
        negative logarithm of the predictive likelihood, large residuals drawn in."""
        return sums(self._residuals(system) ** 2, self._windows.cluster)

    def _residuals(self, system: System) -> np.ndarray:
        found = self._windows.residuals(system, ParameterVector(system).row[None])[0].numpy()
        return np.nan_to_num(found, nan=np.inf)

    def leaning(self, before: System, after: System) -> np.ndarray:
        """``(G,)`` by cluster, see :func:`~nnode.discover.statistics.paired.leaning`."""
        one, other = self._residuals(before), self._residuals(after)
        return leaning(one, other, self._windows.cluster)


def too_few(clusters: int) -> str:
    """Why so many sealed clusters cannot confirm anything; empty where they can."""
    least = least_number(rules().level, sided=1)
    if clusters >= least:
        return ""
    have = {0: "no sealed cluster is", 1: "one sealed cluster is"}.get(
        clusters, f"{clusters} sealed clusters are"
    )
    return f"{have} independent of the open ones, and it takes {least} to confirm anything"
