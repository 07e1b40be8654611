"""Faults of the data: what a camera or a tracking program does to sound trajectories."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.synthetic_cases.case import Case

#: Size of a jump (m), and distance at which two agents count as at one place (m), by domain.
_JUMP = {"traffic": (12.0, 30.0), "crowd": (1.2, 2.5)}
_CLOSE = {"traffic": 0.5, "crowd": 0.03}
#: Seconds that an overlap lasts, by domain.
_LASTS = {"traffic": (1.5, 4.0), "crowd": (0.5, 1.5)}


def insert(
    case: Case, x: np.ndarray, agents: list[list[str]], clock: np.ndarray
) -> tuple[np.ndarray, list[dict[str, Any]]]:
    """Measured positions with one fault of the case's kind in about every fifth sequence.

    * ``identity_swap``: from a sample on two neighbours carry each other's name;
    * ``jump``: from a sample on somebody is elsewhere;
    * ``overlap``: for a while somebody is where the neighbour is.

    Args:
        x: ``(S, K + 1, N)`` or ``(S, K + 1, N, 2)``, m; is not changed.
        agents: names by sequence.
        clock: ``(S, K + 1)`` s.

    Returns:
        The positions and, as the truth has them, the faults: ``kind``, ``sequence``, names of the
        ``agents`` and their ``places`` in the sequence, and the ``time`` of the first wrong sample.
    """
    rng = case.generator("faults")
    x = x.copy()
    sequences, samples, _ = x.shape[:3]
    faults = {}
    for s in map(int, rng.permutation(sequences)[: max(1, sequences // 5)]):
        k = int(rng.integers(round(0.2 * samples), round(0.7 * samples)))
        i, j = _neighbours(rng, x[s, k])
        if case.variant == "identity_swap":
            x[s, k:, [i, j]] = x[s, k:, [j, i]]
        elif case.variant == "jump":
            size = float(rng.uniform(*_JUMP[case.domain]))
            if case.domain == "traffic":
                x[s, k:, i] += size * float(rng.choice([-1, 1]))
            else:
                angle = float(rng.uniform(0, 2 * np.pi))
                x[s, k:, i] += size * np.array([np.cos(angle), np.sin(angle)])
        else:
            last = k + round(float(rng.uniform(*_LASTS[case.domain])) / case.size[2])
            error = _CLOSE[case.domain] * rng.uniform(-1, 1, x[s, k:last, j].shape)
            x[s, k:last, i] = x[s, k:last, j] + error
        places = [i] if case.variant == "jump" else sorted((i, j))
        faults[s] = {
            "kind": case.variant,
            "sequence": case.names[s],
            "agents": [agents[s][place] for place in places],
            "places": places,
            "time": float(clock[s, k]),
        }
    return x, [faults[s] for s in sorted(faults)]


def _neighbours(rng: np.random.Generator, x: np.ndarray) -> tuple[int, int]:
    """Two agents beside each other: followers in a lane, or the nearest in a crowd."""
    if x.ndim == 1:
        i = int(rng.integers(len(x) - 2))
        return i, i + 1
    i = int(rng.integers(len(x)))
    distance = np.hypot(*(x - x[i]).T)
    distance[i] = np.inf
    return i, int(np.argmin(distance))
