"""Faults of the data: what a camera or a tracking program does to sound trajectories."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.synthetic_cases.case import Case

#: Kinds of fault that are inserted.
KINDS = ("identity_swap", "jump", "overlap")

#: Size of a jump (m), and distance at which two agents count as at one place (m), by domain.
_JUMP = {"traffic": (12.0, 30.0), "crowd": (1.2, 2.5)}
_CLOSE = {"traffic": 0.5, "crowd": 0.03}
#: Seconds that an overlap lasts, by domain.
_LASTS = {"traffic": (1.5, 4.0), "crowd": (0.5, 1.5)}


@dataclass(frozen=True)
class Fault:
    """One inserted fault.

    Attributes:
        kind: of :data:`KINDS`.
        sequence: its number.
        agents: their numbers in the sequence.
        sample: the first one that is wrong.
    """

    kind: str
    sequence: int
    agents: tuple[int, ...]
    sample: int

    def to_dict(
        self, names: list[str], agents: list[list[str]], time: np.ndarray
    ) -> dict[str, Any]:
        """As the truth tells it; ``time`` is ``(S, K + 1)`` s."""
        return {
            "kind": self.kind,
            "sequence": names[self.sequence],
            "agents": [agents[self.sequence][i] for i in self.agents],
            "places": list(self.agents),
            "time": float(time[self.sequence, self.sample]),
        }


def insert(case: Case, x: np.ndarray) -> tuple[np.ndarray, list[Fault]]:
    """Measured positions with one fault of the case's kind in about every fifth sequence.

    * ``identity_swap``: from a sample on two neighbours carry each other's name;
    * ``jump``: from a sample on somebody is elsewhere;
    * ``overlap``: for a while somebody is where the neighbour is.

    Args:
        x: ``(S, K + 1, N)`` or ``(S, K + 1, N, 2)``, m; is not changed.

    Returns:
        The positions and the faults.
    """
    rng = case.generator("faults")
    x = x.copy()
    sequences, samples, agents = x.shape[:3]
    found = []
    for s in rng.permutation(sequences)[: max(1, sequences // 5)]:
        k = int(rng.integers(round(0.2 * samples), round(0.7 * samples)))
        i, j = _neighbours(rng, x[s, k], agents)
        if case.variant == "identity_swap":
            x[s, k:, [i, j]] = x[s, k:, [j, i]]
            who: tuple[int, ...] = (i, j)
        elif case.variant == "jump":
            size = float(rng.uniform(*_JUMP[case.domain]))
            if x.ndim == 3:
                x[s, k:, i] += size * float(rng.choice([-1, 1]))
            else:
                angle = float(rng.uniform(0, 2 * np.pi))
                x[s, k:, i] += size * np.array([np.cos(angle), np.sin(angle)])
            who = (i,)
        else:
            last = k + round(float(rng.uniform(*_LASTS[case.domain])) / case.dt)
            error = _CLOSE[case.domain] * rng.uniform(-1, 1, x[s, k:last, j].shape)
            x[s, k:last, i] = x[s, k:last, j] + error
            who = (i, j)
        found.append(Fault(case.variant, int(s), tuple(sorted(who)), k))
    return x, sorted(found, key=lambda fault: fault.sequence)


def _neighbours(rng: np.random.Generator, x: np.ndarray, agents: int) -> tuple[int, int]:
    """Two agents beside each other: followers in a lane, or the nearest in a crowd."""
    if x.ndim == 1:
        i = int(rng.integers(agents - 2))
        return i, i + 1
    i = int(rng.integers(agents))
    distance = np.hypot(*(x - x[i]).T)
    distance[i] = np.inf
    return i, int(np.argmin(distance))
