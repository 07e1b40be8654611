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

from functools import cached_property

import numpy as np

from nnode.calibrate.parameters import ParameterVector
from nnode.data.clusters import least_number
from nnode.data.sequence import Sequence
from nnode.discover.crowds.engine import CrowdEngine
from nnode.discover.found import Simulation
from nnode.discover.lanes.engine import TrafficEngine
from nnode.discover.residuals.engine import Engine
from nnode.discover.residuals.fit import sums
from nnode.discover.rules import rules
from nnode.discover.statistics.paired import leaning
from nnode.model.system import System


def engine_of(
    domain: str,
    sequences: list[Sequence],
    clusters: np.ndarray | None = None,
    whole: bool = False,
) -> Engine:
    """The engine of a domain; ``whole`` compares whole sequences, all errors alike, as most
    calibrations do; people are compared as always."""
    if domain == "crowd":
        return CrowdEngine(sequences, clusters=clusters)
    if whole:
        return TrafficEngine(sequences, np.inf, clusters, np.inf)
    return TrafficEngine(sequences, clusters=clusters)


class Comparing:
    """Models on some sequences.

    Args:
        base: the model around which residuals are whitened and weighted.
        label: ``(S,)`` clusters of the sequences.
    """

    def __init__(
        self, domain: str, sequences: list[Sequence], base: System, label: np.ndarray
    ) -> None:
        self._domain, self._sequences, self._base, self._label = domain, sequences, base, label
        self._whole = engine_of(domain, sequences, label, whole=True)
        self._whole.settle(base, ParameterVector(base).row)

    @property
    def floor(self) -> float:
        """Mean square error of positions that is noise of the measurement, m²."""
        return self._whole.noise_floor()

    @cached_property
    def _windows(self) -> Engine:
        if self._domain == "crowd":
            return self._whole
        found = engine_of(self._domain, self._sequences, self._label)
        found.settle(self._base, ParameterVector(self._base).row)
        return found

    def squares(self, system: System) -> np.ndarray:
        """``(S,)`` mean square errors of positions, m²; NaN where nothing is compared."""
        found = self._whole.squares(system, ParameterVector(system).row).means()
        # the last ones may be too short to be compared
        missing = len(self._sequences) - len(found)
        return np.pad(found, (0, missing), constant_values=np.nan)

    def simulated(self, system: System) -> list[Simulation | None]:
        """The simulations whose errors are :meth:`squares`."""
        return self._whole.simulated(system, ParameterVector(system).row)

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
