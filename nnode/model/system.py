"""A model: a sum of terms, of first order (traffic) or of second order (crowds)."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TypeVar, cast

import torch
from torch import Tensor, nn

from nnode.data.sequence import Batch
from nnode.errors import DataError
from nnode.model.formula import crowd_of, effect_alone, lane_of, rates_of, starts_of
from nnode.model.laws import Law
from nnode.model.scene import DESIRED, Scene, wanted
from nnode.model.term import Interval, State, Term, physical_parameters, short_names
from nnode.model.terms import CrowdDynamics, Dynamics, LaneDynamics

T = TypeVar("T", bound=Term)
N = TypeVar("N", bound=nn.Module)


class System(nn.Module):
    """The right-hand side of an ordinary differential equation as a sum of terms.

    A solver sees ``dy/dt = system(t, y, scene)`` with ``y`` of shape ``(B, N, order * D + M)``:
    positions, in second-order models velocities, and the M additional states that terms own.
    Terms are summed in their order: each can look at the sum before it.

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

    @property
    def step(self) -> str:
        """The method of stepping where none is asked for: the law's own, or ballistic for
        accelerations of vehicles and otherwise Euler's; see :mod:`nnode.model.steps`."""
        return "euler"

    @property
    def formula(self) -> Dynamics | None:
        """The model's formula; None where a term is code without one."""
        return None

    @property
    def names_places(self) -> bool:
        """Whether rates depend on where the origin of positions lies, as with a speed zone; also
        where this is not known, since a term is code."""
        return self.formula is None or self.formula.names_places

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
        """``(B, N, order * D)``: the measured state at the first sample.

        Args:
            step: s, of the solver, for laws whose formula names it.
        """
        start = [batch.x[0], batch.v[0]][: self.order]
        return torch.cat([*start, *self._added(batch, step)], -1)

    @property
    def memory(self) -> int:
        """Number M of states that terms add to those of motion."""
        rules = (term.rule_for(self.order) for term in self._terms())
        return sum(rule.memory for rule in rules if rule is not None)

    def _added(self, batch: Batch, step: float | None) -> list[Tensor]:
        """``(B, N, M)`` the states that terms add, at the start."""
        return []

    def acceleration(self, state: State) -> Tensor:
        """``(B, N, D)``: the sum of all terms, m/s (first order) or m/s² (second order)."""
        return self._rates(state)

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

    def _terms(self) -> list[Term]:
        return cast(list[Term], list(self.terms))

    def _rates(self, state: State, memory: Tensor | None = None) -> Tensor:
        """``(B, N, D + M)`` the sum of the terms, then the rates of the states that they add."""
        terms, total, first = self._terms(), torch.zeros_like(state.x), 0
        added: list[Tensor] = []
        for term in terms:
            rule = term.rule_for(self.order)
            number = 0 if rule is None else rule.memory
            own = None if memory is None else memory[..., first : first + number]
            first += number
            found = term(replace(state, terms=terms, rate=total, memory=own))
            if number:
                added.append(found[..., self.dim :])
                found = found[..., : self.dim]
            total = self._imposed(total + found, state)
        return torch.cat([total, *added], -1) if added else total

    def _imposed(self, rate: Tensor, state: State) -> Tensor:
        """The rates, where some agents' are known from elsewhere."""
        return rate

    def find(self, kind: type[T]) -> T | None:
        """The first term of a kind, or None."""
        return next((term for term in self.terms if isinstance(term, kind)), None)

    def find_law(self, *entries: str) -> Law | None:
        """The first term that was made from one of these entries of the package, or None."""
        laws = (term for term in self.terms if isinstance(term, Law))
        return next((law for law in laws if law.entry in entries), None)

    def extra_repr(self) -> str:
        """The parameters that have a physical meaning, for those who print a model."""
        values = self.physical()
        short = short_names(values)
        return ", ".join(f"{short[name]}={float(x):.5g} {u}" for name, (x, u) in values.items())

    def physical(self) -> dict[str, tuple[Tensor, str]]:
        """Address, as ``lin.v0``, to (value, unit) of the parameters with a physical meaning."""
        return physical_parameters(self)

    def bounds(self) -> dict[str, Interval]:
        """Admissible values by the names of ``named_parameters()``; others are free."""
        return {
            f"terms.{i}.{name}": interval
            for i, term in enumerate(self._terms())
            for name, interval in term.bounds.items()
        }

    def project_(self) -> None:
        """Move every parameter into its admissible set."""
        for term in self._terms():
            term.project_()


class Traffic(System):
    """One lane: dx_i/dt is the sum of the terms, or dv_i/dt where the law says an acceleration.

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
        own = law.step if isinstance(law, Law) else None
        if own == "rk4" and self.formula is not None and "dt" in self.formula.symbols:
            own = None  # an effect that remembers step by step has no stages in between
        return own or ("ballistic" if self.order > 1 else "euler")

    @property
    def formula(self) -> LaneDynamics | None:
        return lane_of(self._terms())

    def _added(self, batch: Batch, step: float | None) -> list[Tensor]:
        if not self.memory:
            return []
        terms, lane, scene = self._terms(), self.formula, self.scene(batch)
        scene = scene if step is None else replace(scene, step=step)
        if lane is None:  # code that remembers nothing does not matter at the start
            rules = [term.rule_for(self.order) for term in terms]
            added = [
                term
                for term, rule in zip(terms[1:], rules[1:], strict=True)
                if rule is not None and rule.memory
            ]
            lane = lane_of([terms[0], *added])
            terms = [terms[0], *added]
        models = [(terms, lane)]
        if lane is None:
            models = [([terms[0], term], effect_alone(terms[0], term)) for term in added]
        found: dict[tuple[int, str], Tensor] = {}
        for i, (own, formula) in enumerate(models):
            assert formula is not None
            starts = starts_of(own, formula, batch.x[0], batch.v[0], scene)
            found |= {(i, state): starts[state] for state in list(formula.rates)[self.order :]}
        return [torch.stack(list(found.values()), -1)]

    def forward(self, t: Tensor, y: Tensor, scene: Scene) -> Tensor:
        place = scene.measured_at(t) if self.leader_measured else None
        return self.rates_behind(t, y, scene, place)

    def rates_behind(self, t: Tensor, y: Tensor, scene: Scene, place: Tensor | None) -> Tensor:
        """The right-hand side where the leader's ``place`` (m) is given, if it is measured."""
        lead = scene.leader[..., None]
        if place is not None:
            measured = [place, scene.measured_rate_at(t)][: self.order]
            y = torch.cat(
                [
                    torch.where(lead, torch.cat(measured, -1), y[..., : self.order]),
                    y[..., self.order :],
                ],
                -1,
            )
        law = self.terms[0]
        # a law of the gap alone computes its speed without a formula of the lane
        alone = len(self.terms) == 1 and isinstance(law, Law) and law.of_gap
        lane = None if alone else self.formula
        if lane is not None:
            rate = rates_of(self._terms(), lane, y, t, scene, place is not None)
            return rate if place is None else rate.masked_fill(lead, 0.0)
        found = self._rates(State(t, y[..., :1], None, scene), y[..., 1:])
        if place is None:
            return found
        # the leader's state is never read: its place is known at every time
        rate = found[..., :1].masked_fill(lead, 0.0)
        return torch.cat([rate, found[..., 1:]], -1)

    def _imposed(self, rate: Tensor, state: State) -> Tensor:
        # of no account for laws of the gap, but effects look at the speed of the vehicle ahead
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
    """Two dimensions: dx_i/dt = v_i, dv_i/dt is the sum of the terms; or dx_i/dt, of a law of
    first order.

    Args:
        desired: where people want to go, see :func:`nnode.model.scene.wanted`.
        neighbours: ``simulated``: people react to each other's simulated states;
            ``measured``: each is simulated alone among the measured paths of the others.
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
        return crowd_of(self._terms())

    def scene(self, batch: Batch) -> Scene:
        return wanted(super().scene(batch), batch, self.desired)

    def forward(self, t: Tensor, y: Tensor, scene: Scene) -> Tensor:
        moving = [y] if self.order == 1 else [y[..., :2], y[..., 2:]]
        seen = None
        if self.neighbours == "measured":
            place = scene.measured_at(t)
            seen = place, place if self.order == 1 else scene.measured_rate_at(t)
        state = State(t, moving[0], moving[1] if self.order > 1 else None, scene, seen=seen)
        return torch.cat([*moving[1:], self._rates(state)], -1)


def with_parameters(module: N, parameters: Mapping[str, Tensor]) -> N:
    """A model or a term with tensors in place of some parameters; the others are shared.

    Args:
        parameters: by their names in ``module.named_parameters()``; of any shape.
    """
    found = copy.copy(module)
    found._parameters, found._modules = dict(module._parameters), dict(module._modules)
    inner: dict[str, dict[str, Tensor]] = {}
    for name, value in parameters.items():
        first, _, rest = name.partition(".")
        if rest:
            inner.setdefault(first, {})[rest] = value
        else:
            found._parameters[name] = value  # type: ignore[assignment]
    for name, own in inner.items():
        part = module._modules[name]
        assert part is not None
        found._modules[name] = with_parameters(part, own)
    return found


def initial_with(
    system: System, parameters: Mapping[str, Tensor], batch: Batch, step: float | None = None
) -> Tensor:
    """``(B, N, W)`` states at the start, with other parameters in place of the model's."""
    return with_parameters(system, parameters).initial(batch, step)
