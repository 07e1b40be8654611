"""Synthetic measured trajectories in which an effect is hidden, and the scoring of a diagnosis.

Nothing here uses the package's models, solvers or calibration, and the diagnosis does not know
this package: right-hand sides, integration (Runge–Kutta of fourth order at a twentieth of the
sampling step) and fits are written once more.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.synthetic_cases.case import ARMS, STRENGTHS, TABLE, TRUTH, WALLS, Case
from benchmarks.synthetic_cases.subject import Subject

__all__ = ["ARMS", "STRENGTHS", "TABLE", "TRUTH", "WALLS", "Case", "generate", "subject_of"]


def subject_of(case: Case) -> Subject:
    """The platoons or crowds of a case; compiled code is loaded for one domain alone."""
    if case.domain == "crowd":
        from benchmarks.synthetic_cases.crowd.case import CrowdCase

        return CrowdCase(case)
    from benchmarks.synthetic_cases.traffic.case import TrafficCase

    return TrafficCase(case)


def generate(case: Case, folder: Path) -> dict[str, Any]:
    """Write a case's ``trajectories.csv``, its ``truth.json`` and, of crowds, ``walls.csv``.

    Args:
        folder: made where it is missing.

    Returns:
        The truth, as ``truth.json`` holds it.
    """
    from benchmarks.synthetic_cases.files import write

    return write(subject_of(case), folder)
