"""What the sealed clusters say, once: is what was found in the open ones true of them?

Models are compared by their predictive likelihood, cluster by cluster: the share by which the sum
of squared whitened residuals falls, one-sided, by sign flips. That takes at least five clusters at
5 %. The mean square error of positions, which the report shows, must fall as well. Effects are
tried in the order in which they were found, each beside those before it, until one fails: so all of
them together keep the level.

Source: Maurer, Hothorn & Lehmacher 1995 (fixed sequences of tests).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nnode.data.clusters import better, least_number
from nnode.data.sequence import Sequence
from nnode.discover.compare import gains
from nnode.discover.crowd import CrowdEngine
from nnode.discover.engine import Engine, row_of
from nnode.discover.traffic import TrafficEngine
from nnode.models.system import System

#: Level of a confirmation.
LEVEL = 0.05


def engine_of(
    domain: str,
    sequences: list[Sequence],
    clusters: np.ndarray | None = None,
    whole: bool = False,
) -> Engine:
    """The engine of a domain; ``whole`` compares whole sequences where that makes sense."""
    if domain == "crowd":
        return CrowdEngine(sequences, clusters=clusters)
    if whole:
        return TrafficEngine(sequences, np.inf, clusters)
    return TrafficEngine(sequences, clusters=clusters)


@dataclass
class Costs:
    """Mean square errors of positions on some sequences, m².

    Args:
        engine: of them, settled.
        label: ``(S,)`` their clusters.
    """

    engine: Engine
    label: np.ndarray

    def of(self, system: System) -> np.ndarray:
        """``(S,)`` of each sequence."""
        return self.engine.squares(system, row_of(system)).means()

    def clustered(self, costs: np.ndarray) -> np.ndarray:
        """``(G,)`` means of costs ``(S,)`` over the sequences of each cluster."""
        return by_cluster(costs, self.label)


def by_cluster(costs: np.ndarray, label: np.ndarray) -> np.ndarray:
    """``(G,)`` means of costs ``(S,)`` over clusters; sequences without a number are left out."""
    known = np.isfinite(costs) | np.isposinf(costs)
    own = np.unique(label[known], return_inverse=True)[1].reshape(-1)
    found: np.ndarray = np.bincount(own, costs[known]) / np.bincount(own)
    return found


def improvement(before: np.ndarray, after: np.ndarray) -> float:
    """One-sided p-value that costs ``(G,)`` fall; 1 where any is infinite afterwards."""
    if not np.isfinite(before).all() or not np.isfinite(after).all():
        return 1.0
    return better(gains(before, after))


def too_few(clusters: int) -> str:
    """Why so many sealed clusters cannot confirm anything; empty where they can."""
    least = least_number(LEVEL, sided=1)
    if clusters >= least:
        return ""
    have = {0: "no sealed cluster is", 1: "one sealed cluster is"}.get(
        clusters, f"{clusters} sealed clusters are"
    )
    return f"{have} independent of the open ones, and it takes {least} to confirm anything"
