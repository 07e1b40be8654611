"""What is calibrated to what: the beginning of every cost."""

from __future__ import annotations

from dataclasses import dataclass

from nnode.calibrate.cost import Convention
from nnode.data.sequence import Batch
from nnode.model.system import System
from nnode.simulate.fused import FusedSolver


@dataclass(eq=False, repr=False)
class Problem:
    """A model on one batch of sequences.

    Attributes:
        system: the model; it is not changed. Parameters that need no gradient stay its own.
        batch: the sequences, in the precision of the system.
        solver: its step, method and threads.
        convention: what is minimised.
    """

    system: System
    batch: Batch
    solver: FusedSolver
    convention: Convention = Convention.integral

    def __post_init__(self) -> None:
        self._own = {name: p for name, p in self.system.named_parameters() if p.requires_grad}
