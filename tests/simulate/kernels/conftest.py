"""Batches that the tests of compiled code share with those of the solvers."""

from __future__ import annotations

from tests.simulate.conftest import crowd, platoon
from tests.simulate.fused.conftest import equal, ragged

__all__ = ["crowd", "equal", "platoon", "ragged"]
