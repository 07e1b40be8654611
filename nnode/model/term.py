"""What a term of a model is: a module with a name, a formula, units and a source."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor, nn

from nnode.model.crowd_dynamics import CrowdRule
from nnode.model.lane_dynamics import Rule
from nnode.model.names import check_names
from nnode.model.scene import Scene

if TYPE_CHECKING:
    from nnode.model.system import System


@dataclass
class State:
    """What the terms of a model see at one moment.

    Attributes:
        t: seconds since the first sample, a scalar tensor, or ``(B,)``.
        x: ``(B, N, D)`` positions, m.
        v: ``(B, N, D)`` velocities, m/s; None in first-order models.
        scene: everything that does not change during the simulation.
        system: the model whose terms are summed; an effect looks there for the law it modifies.
        rate: ``(B, N, D)`` sum of the terms before the one that looks, m/s or m/s².
        memory: ``(B, N, M)`` the M additional states of the term that looks.
        seen: where the others are, ``(x, v)``, for a person who looks around; None where they
            are simulated as well.
    """

    t: Tensor
    x: Tensor
    v: Tensor | None
    scene: Scene
    system: System | None = None
    rate: Tensor | None = None
    memory: Tensor | None = None
    seen: tuple[Tensor, Tensor] | None = None

    @property
    def others(self) -> tuple[Tensor, Tensor]:
        """Positions and velocities of the others, ``(B, N, D)`` each."""
        if self.seen is not None:
            return self.seen
        if self.v is None:
            raise ValueError("a term of a second-order model needs velocities")
        return self.x, self.v


@dataclass(frozen=True)
class Interval:
    """The admissible values of a parameter, [low, high]."""

    low: float = -math.inf
    high: float = math.inf

    def __post_init__(self) -> None:
        if not self.low <= self.high:
            raise ValueError(f"an interval needs low <= high, got [{self.low}, {self.high}]")


class Term(nn.Module):
    """One summand of a model's right-hand side.

    A term returns m/s in a first-order and m/s² in a second-order model, as ``(B, N, D)``;
    padding agents may receive any finite value. Its parameters are declared with
    :meth:`declare`, which records unit and admissible set.

    Class attributes:
        name: the field's name of the effect.
        formula: the formula, in the symbols of the parameters.
        source: where the formula stands.
        memory: number M of additional states of each agent that the term owns.
        fast: parameters that these states' time constants are proportional to, with the factor.
        rule: what it does, as formulas, from which everything is made that computes it; None:
            ``forward`` is code of its own, which runs in PyTorch.
        second: what it does to a law that says an acceleration; None: nothing is known.
        side_by_side: whether ``forward`` takes many simulations at once, with times ``(B,)`` and
            scalar parameters ``(B, 1, 1)``.
    """

    name: ClassVar[str]
    formula: ClassVar[str]
    source: ClassVar[str]
    memory: ClassVar[int] = 0
    fast: ClassVar[dict[str, float]] = {}
    rule: Rule | CrowdRule | None = None
    second: Rule | None = None
    side_by_side: ClassVar[bool] = False

    def __init__(self) -> None:
        super().__init__()
        self.units: dict[str, str] = {}
        self.scalars: list[str] = []
        self.bounds: dict[str, Interval] = {}

    def declare(
        self, name: str, value: float, *, unit: str, bounds: Interval | None = None
    ) -> None:
        """Add a scalar parameter, in float64, with its unit and admissible set.

        Raises:
            ConfigError: its name cannot stand in a formula.
        """
        check_names("parameters", [name], in_code=True)
        start = torch.tensor(float(value), dtype=torch.float64)
        self.register_parameter(name, nn.Parameter(start))
        self.scalars.append(name)
        self.units[name] = unit
        if bounds is not None:
            self.bounds[name] = bounds

    @property
    def shape(self) -> tuple[Any, ...]:
        """What its formula depends on: terms with the same have the same formula."""
        return type(self), tuple(self.scalars)

    def bound_all(self, prefix: str, bounds: Interval) -> None:
        """Give every parameter whose name starts with ``prefix`` the same admissible set."""
        for name, _ in self.named_parameters():
            if name.startswith(prefix):
                self.bounds[name] = bounds

    def idle(self, name: str) -> None:
        """Take a declared parameter out of calibration and out of reports."""
        getattr(self, name).requires_grad_(False)
        del self.units[name]

    @torch.no_grad()
    def project_(self) -> None:
        """Move every parameter to the nearest point of its admissible set."""
        for name, parameter in self.named_parameters():
            bounds = self.bounds.get(name)
            if bounds is not None:
                parameter.clamp_(bounds.low, bounds.high)

    def forward(self, state: State) -> Tensor:
        raise NotImplementedError  # pragma: no cover - every term defines its own

    def inputs(self, scene: Scene) -> dict[str, Tensor]:
        """``(B, N)`` values of what agents have from the data, by the names of the rule's."""
        return {}

    def remember(self, x: Tensor, v: Tensor, system: System) -> Tensor:
        """``(B, N, M)`` the additional states at the start, of positions and velocities then."""
        raise NotImplementedError  # pragma: no cover - every term with a memory defines its own

    def memory_rate(self, state: State) -> Tensor:
        """``(B, N, M)`` time derivative of the additional states."""
        raise NotImplementedError  # pragma: no cover - every term with a memory defines its own


def physical_parameters(module: nn.Module) -> dict[str, tuple[Tensor, str]]:
    """Address to (value, unit) of every declared scalar parameter of the terms in ``module``.

    The address is the term's name and the parameter's, ``lin.v0``: whatever other terms there are,
    it stays the same. Of terms of one name the second is numbered, ``speed_zone_2.alpha``.
    """
    found: dict[str, tuple[Tensor, str]] = {}
    seen: Counter[str] = Counter()
    for term in module.modules():
        if isinstance(term, Term) and term.units:
            seen[term.name] += 1
            owner = term.name if seen[term.name] == 1 else f"{term.name}_{seen[term.name]}"
            for name, unit in term.units.items():
                found[f"{owner}.{name}"] = (getattr(term, name).detach(), unit)
    return found


def short_names(addresses: Iterable[str]) -> dict[str, str]:
    """Addresses of parameters to what is printed: the parameter's name where it is alone."""
    bare = {address: address.rpartition(".")[2] for address in addresses}
    count = Counter(bare.values())
    return {address: name if count[name] == 1 else address for address, name in bare.items()}
