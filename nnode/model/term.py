"""What a term of a model is: a module with a name, a formula, units and a source."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from nnode.model.names import check_names
from nnode.model.scene import Scene
from nnode.model.terms import Rule


@dataclass
class State:
    """What the terms of a model see at one moment.

    Attributes:
        t: seconds since the first sample, a scalar tensor, or ``(B,)``.
        x: ``(B, N, D)`` positions, m.
        v: ``(B, N, D)`` velocities, m/s; None in first-order models.
        scene: everything that does not change during the simulation.
        terms: the model's terms; an effect looks there for the law that it changes.
        rate: ``(B, N, D)`` sum of the terms before, m/s or m/s².
        memory: ``(B, N, M)`` the M states that the term adds.
        seen: where the others are, ``(x, v)``, for a person who looks around; None where they
            are simulated as well.
    """

    t: Tensor
    x: Tensor
    v: Tensor | None
    scene: Scene
    terms: Sequence[Term] = ()
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
        formula: the formula of a term without rules, in the symbols of the parameters.
        source: where the formula stands.
        rule: of a law or a force, its formulas; None: ``forward`` is code, which runs in PyTorch.
        rules: of an effect, the order of a model to what the effect does to it, as formulas.
        fast: parameters that time constants of its states are proportional to, with the factor.
        side_by_side: whether ``forward`` takes many simulations at once, with times ``(B,)`` and
            scalar parameters ``(B, 1, 1)``.
    """

    name: ClassVar[str]
    formula: ClassVar[str] = ""
    source: ClassVar[str]
    rule: Rule | None = None
    rules: ClassVar[Mapping[int, Rule]] = {}
    fast: ClassVar[dict[str, float]] = {}
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

    def rule_for(self, order: int) -> Rule | None:
        """Its formulas in a model of an order; None: there are none, or it is code."""
        return self.rules.get(order)

    @classmethod
    def formula_for(cls, order: int) -> str:
        """Its formula in a model of an order, as text."""
        rule = cls.rules.get(order)
        return cls.formula if rule is None else "; ".join(described(rule))

    @classmethod
    def formula_lines(cls) -> list[str]:
        """Its formulas in all orders, line by line; lines that repeat are left out."""
        found: list[str] = []
        for order, rule in sorted(cls.rules.items()):
            lines = described(rule)
            of = "of an acceleration, " if order == 2 and not rule.of_crowd else ""
            new = [of + lines[0], *(line for line in lines[1:] if line not in found)]
            found += [f"{of}the same"] if lines == found else new
        return found or [cls.formula]

    def forward(self, state: State) -> Tensor:
        """``(B, N, D)`` what it adds to the sum; then the rates of the states that it adds."""
        raise NotImplementedError  # pragma: no cover - every term defines its own

    def inputs(self, scene: Scene) -> dict[str, Tensor]:
        """``(B, N)`` values of what agents have from the data, by the names of the rule's."""
        return {}


#: Entries of a crowd's rule that are reduced over others or walls, in words.
_REDUCED = {
    "others": "sum over others",
    "points": "sum over wall points",
    "walls": "sum over walls",
    "smallest": "smallest over others",
    "largest": "largest over others",
}


def described(rule: Rule, left: str = "W becomes ") -> list[str]:
    """The formulas of a rule, line by line.

    Args:
        left: what stands before the rate of a lane.
    """
    if rule.of_crowd:
        change = "dv{}/dt: {}{}" if rule.order == 2 else "d{}/dt = {}{}"
        found = [
            change.format(axis, "" if rule.order == 1 or text.startswith("-") else "+ ", text)
            for axis, text in zip("xy", rule.rate, strict=True)
        ]
        for over, words in _REDUCED.items():
            parts = getattr(rule, over)
            found += [f"{name} = {words} of {text}" for name, (_, text) in parts.items()]
    else:
        found = [f"{left}{rule.rate}" if rule.rate else f"a leader's W becomes {rule.leader}"]
        found += [
            f"{name} = {text}, {delay} ago (at most {rule.remembered} steps)"
            for name, (text, _, delay) in rule.delayed.items()
        ]
        found += [
            f"d{name}/dt = {rate}, at the start {start}"
            for name, (_, rate, start) in rule.states.items()
        ]
    found += [f"{name} = {text}" for name, text in rule.where.items()]
    found += [
        f"{name} = {value:g} {'' if unit == '1' else unit}".rstrip()
        for name, (value, unit) in rule.constants.items()
    ]
    return found + [
        f"{name}: of each agent, from the data{'' if unit == '1' else f' ({unit})'}"
        for name, unit in rule.inputs.items()
    ]


def physical_parameters(module: nn.Module) -> dict[str, tuple[Tensor, str]]:
    """Address to (value, unit) of every declared scalar parameter of the terms in ``module``.

    The address is the term's name and the parameter's, ``lin.v0``: whatever other terms there are,
    it stays the same. Of terms of one name the second is numbered, ``speed_zone_2.alpha``.
    """
    return {
        address: (getattr(term, name).detach(), term.units[name])
        for address, term, name in _declared(module)
    }


def physical_bounds(module: nn.Module) -> dict[str, Interval]:
    """Address to the admissible values of every parameter of :func:`physical_parameters`."""
    return {address: term.bounds.get(name, Interval()) for address, term, name in _declared(module)}


def _declared(module: nn.Module) -> Iterator[tuple[str, Term, str]]:
    """Address, term and name of every declared scalar parameter."""
    terms = [term for term in module.modules() if isinstance(term, Term) and term.units]
    for owner, term in zip(numbered(term.name for term in terms), terms, strict=True):
        for name in term.units:
            yield f"{owner}.{name}", term, name


def numbered(names: Iterable[str]) -> list[str]:
    """Names of terms, of which the second of one name is numbered, and those after it."""
    seen: Counter[str] = Counter()
    found = []
    for name in names:
        seen[name] += 1
        found.append(name if seen[name] == 1 else f"{name}_{seen[name]}")
    return found


def short_names(addresses: Iterable[str]) -> dict[str, str]:
    """Addresses of parameters to what is printed: the parameter's name where it is alone."""
    bare = {address: address.rpartition(".")[2] for address in addresses}
    count = Counter(bare.values())
    return {address: name if count[name] == 1 else address for address, name in bare.items()}
