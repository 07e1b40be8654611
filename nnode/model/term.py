"""Terms of models: modules with a name, a formula, units and a source."""

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
    """The arguments of a model's terms at one time.

    Attributes:
        t: seconds since the first sample, a scalar tensor, or ``(B,)``.
        x: ``(B, N, D)`` positions, m.
        v: ``(B, N, D)`` velocities, m/s; None in first-order models.
        scene: the fixed surroundings.
        terms: the model's terms, among them the law that an effect changes.
        rate: ``(B, N, D)`` sum of the terms before, m/s or m/s².
        memory: ``(B, N, M)`` the M states that the term adds.
        measured_others: the others' measured positions and velocities; None where others
            are simulated as well.
    """

    t: Tensor
    x: Tensor
    v: Tensor | None
    scene: Scene
    terms: Sequence[Term] = ()
    rate: Tensor | None = None
    memory: Tensor | None = None
    measured_others: tuple[Tensor, Tensor] | None = None

    @property
    def velocity(self) -> Tensor:
        """``(B, N, D)`` m/s.

        Raises:
            ValueError: the model is of first order.
        """
        if self.v is None:
            raise ValueError("a term of a second-order model needs velocities")
        return self.v

    @property
    def others(self) -> tuple[Tensor, Tensor]:
        """Positions and velocities of the others, ``(B, N, D)`` each."""
        return (self.x, self.velocity) if self.measured_others is None else self.measured_others


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
        name: the name of the effect in the literature.
        formula: the formula of a term without rules, in the symbols of the parameters.
        source: reference of the formula.
        rule: the formulas of a law or a force; None if ``forward`` is PyTorch code.
        rules: for an effect, the order of a model to the effect's formulas in it.
        fast: parameter to a factor; the product is a time constant of the term's states.
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
            ConfigError: a formula cannot contain the name.
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
        """Key of the formula: terms with equal keys have equal formulas."""
        return type(self), tuple(self.scalars)

    def idle(self, name: str) -> None:
        """Exclude a declared parameter from calibration and reports."""
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
        """Its formulas in a model of an order; None if there are none."""
        return self.rules.get(order)

    def n_states(self, order: int) -> int:
        """Number of states that it adds to each agent of a model of an order."""
        rule = self.rule_for(order)
        return 0 if rule is None else rule.memory

    @classmethod
    def formula_for(cls, order: int) -> str:
        """Its formula in a model of an order, as text."""
        rule = cls.rules.get(order)
        return cls.formula if rule is None else "; ".join(described(rule))

    @classmethod
    def formula_lines(cls) -> list[str]:
        """Its formulas in all orders, line by line, without repeated lines."""
        collected: list[str] = []
        for order, rule in sorted(cls.rules.items()):
            lines = described(rule)
            of = "of an acceleration, " if order == 2 and not rule.of_crowd else ""
            new = [of + lines[0], *(line for line in lines[1:] if line not in collected)]
            collected += [f"{of}the same"] if lines == collected else new
        return collected or [cls.formula]

    def forward(self, state: State) -> Tensor:
        """``(B, N, D + M)``: its addition to the sum, then the rates of the states that it adds."""
        raise NotImplementedError  # pragma: no cover - every term defines its own

    def inputs(self, scene: Scene) -> dict[str, Tensor]:
        """Name of a rule's input to the agents' values ``(B, N)`` from the data."""
        return {}


#: Descriptions of the entries of a crowd's rule that are reduced over others or walls.
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
        left: prefix of the rate of a lane.
    """
    if rule.of_crowd:
        change = "dv{}/dt: {}{}" if rule.order == 2 else "d{}/dt = {}{}"
        text_lines = [
            change.format(axis, "" if rule.order == 1 or text.startswith("-") else "+ ", text)
            for axis, text in zip("xy", rule.rate, strict=True)
        ]
        for over, words in _REDUCED.items():
            parts = getattr(rule, over)
            text_lines += [f"{name} = {words} of {text}" for name, (_, text) in parts.items()]
    else:
        text_lines = [f"{left}{rule.rate}" if rule.rate else f"a leader's W becomes {rule.leader}"]
        text_lines += [
            f"{name} = {text}, {delay} ago (at most {rule.remembered} steps)"
            for name, (text, _, delay) in rule.delayed.items()
        ]
        text_lines += [
            f"d{name}/dt = {rate}, at the start {start}"
            for name, (_, rate, start) in rule.states.items()
        ]
    text_lines += [f"{name} = {text}" for name, text in rule.where.items()]
    text_lines += [
        f"{name} = {value:g} {'' if unit == '1' else unit}".rstrip()
        for name, (value, unit) in rule.constants.items()
    ]
    return text_lines + [
        f"{name}: of each agent, from the data{'' if unit == '1' else f' ({unit})'}"
        for name, unit in rule.inputs.items()
    ]


def physical_parameters(module: nn.Module) -> dict[str, tuple[Tensor, str]]:
    """Address to (value, unit) of every declared scalar parameter of the terms in ``module``.

    The address consists of the term's name and the parameter's name, ``lin.v0``, and does not
    depend on the other terms. Repeated names of terms are numbered, ``speed_zone_2.alpha``.
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
    """Unique names of terms: repeated names are numbered from the second on."""
    count: Counter[str] = Counter()
    unique = []
    for name in names:
        count[name] += 1
        unique.append(name if count[name] == 1 else f"{name}_{count[name]}")
    return unique


def short_names(addresses: Iterable[str]) -> dict[str, str]:
    """Addresses of parameters to printed names: the parameter's name, if it is unique."""
    bare = {address: address.rpartition(".")[2] for address in addresses}
    count = Counter(bare.values())
    return {address: name if count[name] == 1 else address for address, name in bare.items()}
