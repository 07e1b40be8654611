"""Synthetic measured trajectories in which an effect is hidden, and the scoring of a diagnosis.

Nothing here uses the package's models, solvers or calibration, and the diagnosis does not know
this package: right-hand sides, integration (Runge–Kutta of fourth order at a twentieth of the
sampling step) and fits are written once more.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.synthetic_cases.case import ARMS, STRENGTHS, TABLE, TRUTH, WALLS, Case

__all__ = ["ARMS", "STRENGTHS", "TABLE", "TRUTH", "WALLS", "Case", "generate"]


def generate(case: Case, folder: Path) -> dict[str, Any]:
    """Write a case's ``trajectories.csv``, its ``truth.json`` and, of crowds, ``walls.csv``.

    Args:
        folder: made where it is missing.

    Returns:
        The truth, as ``truth.json`` holds it.

    Raises:
        ConfigError: an effect that the domain does not know.
    """
    from benchmarks.synthetic_cases.files import write

    # compiled code is loaded for one domain alone
    if case.domain == "crowd":
        from benchmarks.synthetic_cases.crowd.case import CrowdCase

        return write(CrowdCase(case), folder)
    from benchmarks.synthetic_cases.traffic.case import TrafficCase

    return write(TrafficCase(case), folder)
