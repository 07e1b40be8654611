"""Batches that the tests of compiled code share with those of the solvers."""

from __future__ import annotations

from tests.simulation.conftest import crowd, platoon
from tests.simulation.fused.conftest import equal, ragged

__all__ = ["crowd", "equal", "platoon", "ragged"]
