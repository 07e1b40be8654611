"""A model: a sum of terms, of first order (traffic) or of second order (crowds)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeVar

import torch
from torch import Tensor, nn

from nnode.data.sequence import Batch
from nnode.errors import DataError
from nnode.models.scene import Scene
from nnode.models.term import State, Term, physical_parameters

T = TypeVar("T", bound=Term)


class System(nn.Module):
    """The right-hand side of an ordinary differential equation as a sum of terms.

    A solver sees ``dy/dt = system(t, y, scene)`` with ``y`` of shape ``(B, N, order * D)``.

    Attributes:
        domain: ``traffic`` or ``crowd``.
        order: 1, y = x; or 2, y = (x, v).
        dim: D, the number of space dimensions.
        terms: the summands.
        wall_spacing: walls become points this far apart, m.
    """

    domain: str
    order: int
    dim: int

    def __init__(self, terms: Iterable[Term], wall_spacing: float = 0.25) -> None:
        super().__init__()
        if not wall_spacing > 0:
            raise ValueError(f"wall_spacing={wall_spacing} must be a positive number of metres")
        self.terms = nn.ModuleList(terms)
        self.wall_spacing = wall_spacing

    def scene(self, batch: Batch) -> Scene:
        """The fixed surroundings of a batch.

        Raises:
            DataError: the batch is of another domain.
        """
        if batch.x.shape[-1] != self.dim:
            raise DataError(
                f"a {self.domain} model needs {self.dim}-dimensional positions, the data have "
                f"{batch.x.shape[-1]}; choose a model and data of the same domain"
            )
        return Scene.of(batch, self.wall_spacing)

    def initial(self, batch: Batch) -> Tensor:
        """``(B, N, order * D)``: the measured state at the first sample."""
        parts = [batch.x[0], batch.v[0]][: self.order]
        return torch.cat(parts, -1)

    def acceleration(self, state: State) -> Tensor:
        """``(B, N, D)``: the sum of all terms, m/s (first order) or m/s² (second order)."""
        return sum((term(state) for term in self.terms), torch.zeros_like(state.x))

    def observe(self, y: Tensor, batch: Batch) -> tuple[Tensor, Tensor | None]:
        """Positions and, in second-order models, velocities of the states at the samples."""
        if self.order == 1:
            return y, None
        return y[..., : self.dim], y[..., self.dim :]

    def find(self, kind: type[T]) -> T | None:
        """The first term of a kind, or None."""
        return next((term for term in self.terms if isinstance(term, kind)), None)

    def physical(self) -> dict[str, tuple[Tensor, str]]:
        """Name to (value, unit) of the parameters that have a physical meaning."""
        return physical_parameters(self)

    def project_(self) -> None:
        """Move every parameter into its admissible set."""
        for term in self.terms:
            assert isinstance(term, Term)
            term.project_()


class Traffic(System):
    """First order, one lane: dx_i/dt is the sum of the terms.

    Args:
        leader: ``constant``: the leader drives at its law's v0; ``measured``: it follows its
            recorded trajectory, and v0 acts only where the followers' law contains it.
    """

    domain = "traffic"
    order = 1
    dim = 1

    def __init__(self, terms: Iterable[Term], leader: str = "constant") -> None:
        super().__init__(terms)
        if leader not in ("constant", "measured"):
            raise ValueError(f"leader={leader} is unknown, expected constant or measured")
        self.leader = leader

    def forward(self, t: Tensor, y: Tensor, scene: Scene) -> Tensor:
        if self.leader == "constant":
            return self.acceleration(State(t, y, None, scene))
        lead = scene.leader[..., None]
        x = torch.where(lead, scene.measured_at(t), y)
        # the leader's state is never read: its place is known at every time
        return self.acceleration(State(t, x, None, scene)).masked_fill(lead, 0.0)

    def observe(self, y: Tensor, batch: Batch) -> tuple[Tensor, Tensor | None]:
        if self.leader == "constant":
            return y, None
        number = batch.agent.sum(1)
        lead = torch.arange(y.shape[2], device=y.device) == (number - 1)[:, None]
        return torch.where(lead[..., None], batch.x, y), None


class Crowd(System):
    """Second order, two dimensions: dx_i/dt = v_i, dv_i/dt is the sum of the terms."""

    domain = "crowd"
    order = 2
    dim = 2

    def forward(self, t: Tensor, y: Tensor, scene: Scene) -> Tensor:
        x, v = y[..., :2], y[..., 2:]
        return torch.cat([v, self.acceleration(State(t, x, v, scene))], -1)
