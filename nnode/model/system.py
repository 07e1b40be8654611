"""Models: sums of terms, of first or second order."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TypeVar, cast

import torch
from torch import Tensor, nn

from nnode.data.sequence import Batch, Domain
from nnode.errors import DataError
from nnode.model.formula import crowd_of, effect_alone, lane_of, rates_of, starts_of
from nnode.model.laws import Law
from nnode.model.scene import DESIRED, Scene, with_destinations
from nnode.model.term import Interval, State, Term, physical_parameters, short_names
from nnode.model.terms import CrowdDynamics, Dynamics, LaneDynamics

T = TypeVar("T", bound=Term)
N = TypeVar("N", bound=nn.Module)


class System(nn.Module):
    """The right-hand side of an ordinary differential equation as a sum of terms.

    A solver integrates ``dy/dt = system(t, y, scene)`` with ``y`` of shape
    ``(B, N, order * D + M)``: positions, velocities in second-order models, and the M additional
    states of terms. Terms are summed in their order, and each can use the sum of those before it.

    Attributes:
        domain: ``traffic`` or ``crowd``.
        order: 1, y = x; or 2, y = (x, v).
        dim: D, the number of space dimensions.
        terms: the summands.
        wall_spacing: largest distance between the points that represent a wall, m.
    """

    domain: Domain
    order: int
    dim: int

    def __init__(self, terms: Iterable[Term], wall_spacing: float = 0.25) -> None:
        super().__init__()
        if not wall_spacing > 0:
            raise ValueError(f"wall_spacing={wall_spacing} must be a positive number of metres")
        self.terms = nn.ModuleList(terms)
        self.wall_spacing = wall_spacing

    @property
    def step(self) -> str:
        """The default method of stepping: the law's method if it has one, ballistic for
        accelerations of vehicles, and Euler's otherwise; see :mod:`nnode.model.steps`."""
        return "euler"

    @property
    def formula(self) -> Dynamics | None:
        """The model's formula; None if a term is code without a formula."""
        return None

    @property
    def is_map(self) -> bool:
        """Whether it is a formula that maps one step to the next."""
        return self.formula is not None and self.formula.is_map

    @property
    def depends_on_position(self) -> bool:
        """Whether rates depend on the origin of positions, as with a speed zone. It is True as
        well for models without a formula, where this is unknown."""
        return self.formula is None or self.formula.depends_on_position

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

    def initial(self, batch: Batch, step: float | None = None) -> Tensor:
        """``(B, N, order * D + M)``: the measured state and the terms' states at the first sample.

        Args:
            step: the solver's time step, s, for laws whose formula names it.
        """
        start = [batch.x[0], batch.v[0]][: self.order]
        return torch.cat([*start, *self._added(batch, step)], -1)

    @property
    def memory(self) -> int:
        """Number M of the states that terms add."""
        return sum(term.n_states(self.order) for term in self.term_list)

    def _added(self, batch: Batch, step: float | None) -> list[Tensor]:
        """One array ``(B, N, M)`` of the terms' states at the start, or none."""
        return []

    def observe(self, y: Tensor, batch: Batch) -> tuple[Tensor, Tensor | None]:
        """Positions and, in second-order models, velocities of the states at the samples."""
        if self.order == 1:
            return y[..., : self.dim], None
        return y[..., : self.dim], y[..., self.dim : 2 * self.dim]

    def given(self, batch: Batch) -> Tensor | None:
        """``(B, N)`` True for agents that follow their measured paths; None: there is none."""
        return None

    @property
    def leader_measured(self) -> bool:
        """Whether the first vehicle of every sequence follows its measured path."""
        return False

    @property
    def term_list(self) -> list[Term]:
        """The terms as a list with their type."""
        return cast(list[Term], list(self.terms))

    def _rates(self, state: State, memory: Tensor | None = None) -> Tensor:
        """``(B, N, D + M)``: the sum of the terms, then the rates of the states that they add."""
        terms, total, first = self.term_list, torch.zeros_like(state.x), 0
        added: list[Tensor] = []
        for term in terms:
            number = term.n_states(self.order)
            own = slice(first, first + number)
            term_memory = memory[..., own] if memory is not None and number else None
            first = own.stop
            rate = term(replace(state, terms=terms, rate=total, memory=term_memory))
            if number:
                added.append(rate[..., self.dim :])
                rate = rate[..., : self.dim]
            total = self._imposed(total + rate, state)
        return torch.cat([total, *added], -1) if added else total

    def _imposed(self, rate: Tensor, state: State) -> Tensor:
        """The rates, with prescribed values for agents that follow their measured paths."""
        return rate

    def find(self, kind: type[T]) -> T | None:
        """The first term of a kind, or None."""
        return next((term for term in self.terms if isinstance(term, kind)), None)

    def find_law(self, *entries: str) -> Law | None:
        """The first law that was made from one of these package entries, or None."""
        laws = (term for term in self.terms if isinstance(term, Law))
        return next((law for law in laws if law.entry in entries), None)

    def extra_repr(self) -> str:
        """The parameters with a physical meaning, for the printed model."""
        values = self.physical()
        short = short_names(values)
        return ", ".join(f"{short[name]}={float(x):.5g} {u}" for name, (x, u) in values.items())

    def physical(self) -> dict[str, tuple[Tensor, str]]:
        """Address, such as ``lin.v0``, to (value, unit) of the physical parameters."""
        return physical_parameters(self)

    def bounds(self) -> dict[str, Interval]:
        """Admissible values by the names of ``named_parameters()``; others are free."""
        return {
            f"terms.{i}.{name}": interval
            for i, term in enumerate(self.term_list)
            for name, interval in term.bounds.items()
        }

    def project_(self) -> None:
        """Move every parameter into its admissible set."""
        for term in self.term_list:
            term.project_()


def _joined(first: Tensor, added: Tensor) -> Tensor:
    """States followed by those that terms add, which most models do not have."""
    return torch.cat([first, added], -1) if added.shape[-1] else first


class Traffic(System):
    """One lane: the sum of the terms is dx_i/dt, or dv_i/dt for a law of second order.

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
        first = self.terms[0] if len(self.terms) else None
        self.order = first.order if isinstance(first, Law) else 1

    @property
    def step(self) -> str:
        law = self.terms[0] if len(self.terms) else None
        method = law.step if isinstance(law, Law) else None
        if method == "rk4" and self.is_map:
            method = None  # an effect that remembers step by step has no stages in between
        return method or ("ballistic" if self.order > 1 else "euler")

    @property
    def formula(self) -> LaneDynamics | None:
        return lane_of(self.term_list)

    def _added(self, batch: Batch, step: float | None) -> list[Tensor]:
        if not self.memory:
            return []
        terms, lane, scene = self.term_list, self.formula, self.scene(batch)
        scene = scene if step is None else replace(scene, step=step)
        if lane is None:  # terms without states do not affect the start values
            added = [term for term in terms[1:] if term.n_states(self.order)]
            terms = [terms[0], *added]
            lane = lane_of(terms)
        models = [(terms, lane)]
        if lane is None:
            models = [([terms[0], term], effect_alone(terms[0], term)) for term in added]
        start_values: list[Tensor] = []
        for model_terms, formula in models:
            assert formula is not None
            starts = starts_of(model_terms, formula, batch.x[0], batch.v[0], scene)
            start_values += [starts[state] for state in list(formula.rates)[self.order :]]
        return [torch.stack(start_values, -1)]

    def forward(self, t: Tensor, y: Tensor, scene: Scene) -> Tensor:
        lead = scene.leader[..., None]
        if self.leader_measured:
            measured = [scene.measured_at(t), scene.measured_rate_at(t)][: self.order]
            moved = torch.where(lead, torch.cat(measured, -1), y[..., : self.order])
            y = _joined(moved, y[..., self.order :])
        law = self.terms[0]
        # a law of only the gap computes its speed without the lane's formula
        alone = len(self.terms) == 1 and isinstance(law, Law) and law.of_gap
        lane = None if alone else self.formula
        if lane is not None:
            rate = rates_of(self.term_list, lane, y, t, scene, self.leader_measured)
            return rate.masked_fill(lead, 0.0) if self.leader_measured else rate
        rates = self._rates(State(t, y[..., :1], None, scene), y[..., 1:])
        if not self.leader_measured:
            return rates
        # the leader's state is never read: its place is known at every time
        return _joined(rates[..., :1].masked_fill(lead, 0.0), rates[..., 1:])

    def _imposed(self, rate: Tensor, state: State) -> Tensor:
        # effects depend on the speed of the vehicle ahead; laws of the gap alone do not
        if not self.leader_measured or len(self.terms) == 1:
            return rate
        speed = state.scene.measured_rate_at(state.t)
        return torch.where(state.scene.leader[..., None], speed, rate)

    def observe(self, y: Tensor, batch: Batch) -> tuple[Tensor, Tensor | None]:
        x, v = super().observe(y, batch)
        given = self.given(batch)
        if given is None:
            return x, v
        lead = given[..., None]
        return torch.where(lead, batch.x, x), None if v is None else torch.where(lead, batch.v, v)

    @property
    def leader_measured(self) -> bool:
        return self.leader == "measured"

    def given(self, batch: Batch) -> Tensor | None:
        if not self.leader_measured:
            return None
        index = torch.arange(batch.agent.shape[1], device=batch.agent.device)
        return index == (batch.agent.sum(1) - 1)[:, None]


class Crowd(System):
    """People in the plane: dx_i/dt = v_i, and dv_i/dt is the sum of the terms. For a law of first
    order, dx_i/dt is the sum.

    Args:
        desired: where people want to go, see :func:`nnode.model.scene.with_destinations`.
        neighbours: ``simulated``: people react to each other's simulated states;
            ``measured``: each person is simulated among the measured paths of the others.
    """

    domain = "crowd"
    order = 2
    dim = 2

    def __init__(
        self,
        terms: Iterable[Term],
        wall_spacing: float = 0.25,
        neighbours: str = "simulated",
        desired: str = "last",
    ) -> None:
        super().__init__(terms, wall_spacing)
        if desired not in DESIRED:
            raise ValueError(f"desired={desired} is unknown, expected {', '.join(DESIRED)}")
        self.desired = desired
        if any(isinstance(term, Law) and term.order == 1 for term in self.terms):
            self.order = 1
        if neighbours not in ("simulated", "measured"):
            raise ValueError(f"neighbours={neighbours} is unknown, expected simulated or measured")
        self.neighbours = neighbours

    @property
    def formula(self) -> CrowdDynamics | None:
        return crowd_of(self.term_list)

    @property
    def law_formula(self) -> CrowdDynamics | None:
        """The formula of its laws without effects; None where one is code without a formula."""
        return crowd_of([term for term in self.term_list if isinstance(term, Law)])

    def scene(self, batch: Batch) -> Scene:
        return with_destinations(super().scene(batch), batch, self.desired)

    def forward(self, t: Tensor, y: Tensor, scene: Scene) -> Tensor:
        moving = [y] if self.order == 1 else [y[..., :2], y[..., 2:]]
        measured_others = None
        if self.neighbours == "measured":
            place = scene.measured_at(t)
            measured_others = place, place if self.order == 1 else scene.measured_rate_at(t)
        state = State(
            t,
            moving[0],
            moving[1] if self.order > 1 else None,
            scene,
            measured_others=measured_others,
        )
        return torch.cat([*moving[1:], self._rates(state)], -1)


def with_parameters(module: N, parameters: Mapping[str, Tensor]) -> N:
    """A copy of a model or term with tensors in place of some parameters; it shares the others.

    Args:
        parameters: name in ``module.named_parameters()`` to a tensor of any shape.
    """
    copied = copy.copy(module)
    copied._parameters, copied._modules = dict(module._parameters), dict(module._modules)
    by_module: dict[str, dict[str, Tensor]] = {}
    for name, value in parameters.items():
        first, _, inner_name = name.partition(".")
        if inner_name:
            by_module.setdefault(first, {})[inner_name] = value
        else:
            copied._parameters[name] = value  # type: ignore[assignment]
    for name, inner_parameters in by_module.items():
        part = module._modules[name]
        assert part is not None
        copied._modules[name] = with_parameters(part, inner_parameters)
    return copied
