"""Fixtures of the tests of solvers."""

from __future__ import annotations

import pytest

from nnode.data.sequence import Sequence
from nnode.simulation import fused
from nnode.simulation.kernels import lanes
from tests.simulation.kernels.interpreted import interpreted
from tests.simulation.scenes import platoon


@pytest.fixture
def without_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    """Generated code of lanes is interpreted."""
    monkeypatch.setattr(lanes, "compiled", interpreted)


@pytest.fixture
def without_fallback(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fused solver cannot use PyTorch in place of compiled code."""
    monkeypatch.delattr(fused, "TorchdiffeqSolver")


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
    """Forty platoons of four vehicles, which fill more than one block of compiled code."""
    return [
        platoon([10.0 + 0.3 * i, 20.0 - 0.2 * i, 15.0], samples=4, name=f"e{i}") for i in range(40)
    ]
