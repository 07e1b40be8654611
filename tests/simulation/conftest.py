"""Batches that the solvers' tests share."""

from __future__ import annotations

import pytest

from nnode.data.sequence import Sequence
from tests.simulation.scenes import platoon


@pytest.fixture(scope="session")
def ragged() -> list[Sequence]:
    """Platoons of one to four vehicles that end at different times."""
    return [
        platoon([12.0, 25.0, 9.0], samples=4, name="a"),
        platoon([7.0], samples=7, name="b"),
        platoon([], samples=2, name="c"),
        platoon([14.0, 11.0], samples=6, name="d", start=700.0),
    ]


@pytest.fixture(scope="session")
def equal() -> list[Sequence]:
    """Forty platoons of four vehicles: more than one block, and blocks that are not full."""
    return [
        platoon([10.0 + 0.3 * i, 20.0 - 0.2 * i, 15.0], samples=4, name=f"e{i}") for i in range(40)
    ]
