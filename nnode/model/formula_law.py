"""Laws that are one formula: a user's own, and those of the field."""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from nnode.errors import ConfigError
from nnode.model.crowd_dynamics import OTHERS, POINTS, SMALLEST, WALLS, CrowdRule
from nnode.model.crowd_formula import CrowdBase, formula_of
from nnode.model.expression import Expr, const, symbol
from nnode.model.formula import Law, parameters_of
from nnode.model.lane_dynamics import LaneDynamics, Rule, of_rule
from nnode.model.names import check_names
from nnode.model.network import FeedForward
from nnode.model.parse import parse
from nnode.model.steps import METHODS
from nnode.model.term import Interval, State, Term
from nnode.model.units import in_si

#: What is 0 where everybody drives at one speed, as far as a law may name it.
_AT_REST = ("dv", "t", "clock", "x", "x_1", "x_2", "v_2", "length_1", "gap_1", "dx_1", "v", "v_1")
#: The step that a map from step to step is shown with, s.
_STEP = 0.1
#: No vehicle is faster, m/s.
FASTEST = 100.0
#: What a law's description may say.
_KEYS = (
    "parameters",
    "constants",
    "where",
    "delayed",
    "remembered",
    "states",
    "step",
    "rate",
    "source",
)
_CROWD_KEYS = ("parameters", "constants", "where", "rate", "source")
#: Entries of both that are mappings.
_MAPPINGS = ("parameters", "constants", "where", "delayed", "states")
_SUMS = (OTHERS, POINTS, WALLS)
#: A network beside a law, by its order: what is named is brought to the size of one, SI units.
_BESIDE = {1: "NN(gap/20)", 2: "NN(gap/20, v/10, dv/2)"}
_CALLS = re.compile(r"\bNN\s*\(")
_LARGEST = "largest"
#: Entries that are reduced over others or walls.
_REDUCED = (*_SUMS, SMALLEST, _LARGEST)
_PARAMETER = ("value", "low", "high")


def _three(key: str, name: Any, given: Any) -> tuple[str, str, str]:
    """An entry of ``states`` or ``delayed``."""
    if isinstance(given, str) or not isinstance(given, Sequence) or len(given) != 3:
        wanted = {"states": "[unit, rate, start]", "delayed": "[formula, unit, delay]"}[key]
        raise ConfigError(f"model.law.{key}.{name}={given} must be {wanted}")
    first, second, third = map(str, given)
    return first, second, third


class _Own(Term):
    """What laws of one's own share."""

    def _declare(self, name: str, given: Any) -> None:
        check_names("model.law.parameters", [name])
        if hasattr(self, name):
            raise ConfigError(f"model.law.parameters: {name} cannot be the name of a parameter")
        entry = given if isinstance(given, Mapping) else {"value": given}
        unknown = sorted(set(entry) - set(_PARAMETER))
        if unknown or "value" not in entry:
            raise ConfigError(
                f"model.law.parameters.{name}={given}: expected a quantity such as 30 m/s, or "
                "{value: 30 m/s, low: 0 m/s, high: 60 m/s}"
            )
        found = {key: in_si(str(value)) for key, value in entry.items()}
        units = {unit for _, unit in found.values()}
        if len(units) > 1:
            raise ConfigError(
                f"model.law.parameters.{name} has the units {', '.join(sorted(units))}; value, "
                "low and high need the same kind of unit"
            )
        bounds = {key: value for key, (value, _) in found.items() if key != "value"}
        self.declare(
            name, found["value"][0], unit=units.pop(), bounds=Interval(**bounds) if bounds else None
        )

    @property
    def shape(self) -> tuple[Any, ...]:
        return (*super().shape, self.name, repr(self.rule), tuple(self.units.items()))


class FormulaLaw(_Own, Law):
    """A law of a lane, written as a formula; of first order if it says dx/dt, of second if dv/dt.

    Args:
        name: of the law.
        parameters: name to a quantity with its unit, ``30 m/s``, or to a mapping of ``value``,
            ``low`` and ``high``.
        rate: ``{x: formula}``, m/s, or ``{v: formula}``, m/s²; what it may name stands in
            :mod:`nnode.model.lane_dynamics`.
        where: name to formula of parts.
        source: where it comes from.
        constants: name to a quantity that is not calibrated.
        delayed: name to ``[formula, delay]``, a value some time ago, of at most ``remembered``
            steps; the law is then a map from step to step.
        states: name to ``[unit, rate, start]``, formulas, of what a vehicle remembers.
        step: the law's own method of stepping, see :mod:`nnode.model.steps`; None: ballistic for
            an acceleration. ``rk4`` is ballistic beside an effect that remembers step by step.
        network: neurons of the hidden layer of NN, a network that formulas may call with any
            inputs; where the rate does not, NN(gap/20, v/10, dv/2) is added to it, in SI
            units, and starts at 0. None: there is none.
        box: weights stay in [-box, box]; None leaves them free.
        generator: of the first weights.

    A leader that drives by itself keeps the speed v0 in a law of first order, which must have
    such a parameter then, and its first speed in one of second order.

    Raises:
        ConfigError: what is missing, cannot be read, or has the wrong unit.
    """

    def __init__(
        self,
        name: str,
        parameters: Mapping[str, Any],
        rate: Mapping[str, str],
        where: Mapping[str, str] | None = None,
        source: str = "",
        *,
        constants: Mapping[str, str] | None = None,
        delayed: Mapping[str, Sequence[str]] | None = None,
        remembered: int = 0,
        states: Mapping[str, Sequence[str]] | None = None,
        step: str | None = None,
        network: int | None = None,
        box: float | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        check_names("model.name", [name])
        self.name, self.source = str(name), str(source)  # type: ignore[misc]
        self.network: FeedForward | None = None
        if not isinstance(rate, Mapping) or list(rate) not in (["x"], ["v"]):
            raise ConfigError(
                f"model.law.rate={rate} must be one entry, x: a formula of a speed (first order) "
                "or v: a formula of an acceleration (second order); or vx and vy, of a crowd, or "
                "x and y, of a crowd of first order"
            )
        ((state, text),) = rate.items()
        self.order = 1 if state == "x" else 2
        parts = {str(k): str(v) for k, v in (where or {}).items()}
        text, beside = str(text), False
        calls = any(_CALLS.search(t) for t in (text, *parts.values()))
        if calls and network is None:
            raise ConfigError(
                f"model.law of {self.name} calls NN, a network: say how many neurons its hidden "
                "layer has, as model.network=4"
            )
        if network is not None and not calls:
            text, beside = f"{text} + {_BESIDE[self.order]}", True
        self.formula = text  # type: ignore[misc]
        self.rule = Rule(
            rate=text,
            where=parts,
            constants={str(k): in_si(str(v)) for k, v in (constants or {}).items()},
            states={str(k): _three("states", k, v) for k, v in (states or {}).items()},
            delayed={str(k): _three("delayed", k, v) for k, v in (delayed or {}).items()},
            remembered=int(remembered),
        )
        self.step = step
        if step is not None and step not in METHODS:
            raise ConfigError(f"model.law.step={step} is unknown, expected {', '.join(METHODS)}")
        for own, value in parameters.items():
            self._declare(str(own), value)
        if network is not None:
            self._connect(network, beside, generator)
            if box is not None:
                self.bound_all("network.", Interval(-box, box))
        self.lane(self.name)  # says what is wrong with the formula

    def _connect(self, hidden: int, beside: bool, generator: torch.Generator | None) -> None:
        """Make the network, of as many inputs as the formula gives it."""
        inputs: set[int] = set()

        def count(*values: Expr) -> Expr:
            inputs.add(len(values))
            return const(0)

        assert isinstance(self.rule, Rule)
        for text in (self.rule.rate, *self.rule.where.values()):
            parse(text, None, {"NN": count})
        if len(inputs) != 1:
            raise ConfigError(
                f"model.law of {self.name}: NN is called with {sorted(inputs) or 'no'} inputs, "
                "expected the same number everywhere"
            )
        self.network = FeedForward((inputs.pop(), int(hidden), 1), generator)
        if beside:
            with torch.no_grad():
                for weight in self.network.layers[-1].parameters():
                    weight.zero_()

    @property
    def shape(self) -> tuple[Any, ...]:
        return (*super().shape, None if self.network is None else self.network.sizes)

    def lane(self, owner: str) -> LaneDynamics:
        parameters, owned, units = parameters_of(self, owner, 0)
        laws: dict[str, Any] = {}
        if self.network is not None:
            network, label, path = self.network, f"{owner}__n", "terms.0.network."
            _, weights = network.written([const(0)] * network.sizes[0], label, path)
            owned.update(weights)
            units.update(dict.fromkeys(weights, "*"))
            laws["NN"] = lambda *inputs: network.written(list(inputs), label, path)[0][0]
        leader = symbol("v")
        if self.order == 1:
            leader = parameters.get("v0", symbol("measured"))
        assert isinstance(self.rule, Rule)
        return of_rule(owner, self.rule, self.order, parameters, leader, owned, units, laws)

    def speed(self, gap: Tensor) -> Tensor:
        """W at a gap (m) where everybody drives at one speed, m/s; the least such speed of an
        acceleration that is not negative at rest, up to 100 m/s."""
        zero = torch.zeros_like(gap)
        known = {**dict.fromkeys(_AT_REST, zero), "gap": gap, "x_1": gap, "dt": zero + _STEP}
        lane = self.lane(self.name).flat()

        def says(v: Tensor) -> Tensor:
            """The formula where everybody has driven at v for long."""
            values = {**known, "v": v, "v_1": v, "dx_1": v, **dict.fromkeys(lane.starts, zero)}
            begun = self.computed(list(lane.starts.values()), values)
            values |= dict(zip(lane.starts, begun, strict=True))
            return self.evaluated(values).expand_as(gap)

        if self.order == 1:
            return says(zero)
        low, high = zero, torch.full_like(gap, FASTEST)
        for _ in range(60):
            half = (low + high) / 2
            faster = says(half) > 0
            low, high = torch.where(faster, half, low), torch.where(faster, high, half)
        return torch.where(says(zero) > 0, low, zero)

    def forward(self, state: State) -> Tensor:
        raise ConfigError(
            f"the law {self.name} is a formula and cannot be mixed with terms that are code"
        )


class FormulaForce(_Own, CrowdBase):
    """A law of people, written as formulas of both components of their acceleration, or velocity.

    Args:
        name, parameters, where, source: as of :class:`FormulaLaw`.
        rate: ``{vx: formula, vy: formula}``, m/s², or ``{x: formula, y: formula}``, m/s, of a law
            of first order; what they may name stands in :mod:`nnode.model.crowd_dynamics`.
        constants: name to a quantity that is not calibrated.
        others, points, walls: name to summand of sums over the others, wall points, walls.
        smallest, largest: name to formula of smallest and largest values over the others.

    Raises:
        ConfigError: what is missing, cannot be read, or has the wrong unit.
    """

    def __init__(
        self,
        name: str,
        parameters: Mapping[str, Any],
        rate: Mapping[str, str],
        where: Mapping[str, str] | None = None,
        source: str = "",
        constants: Mapping[str, str] | None = None,
        **sums: Mapping[str, str],
    ) -> None:
        super().__init__()
        check_names("model.name", [name])
        self.name, self.source = str(name), str(source)  # type: ignore[misc]
        axes = ("x", "y") if set(rate) == {"x", "y"} else ("vx", "vy")
        if set(rate) != set(axes):
            raise ConfigError(
                f"model.law.rate={rate} must have two entries, vx and vy: formulas of both "
                "components of a person's acceleration; or x and y: of his velocity"
            )
        self.order = 1 if axes == ("x", "y") else 2
        first, second = (str(rate[axis]) for axis in axes)
        self.formula = f"{first}, {second}"  # type: ignore[misc]
        over = {
            kind: {str(part): ("", str(text)) for part, text in (found or {}).items()}
            for kind, found in sums.items()
        }
        parts = {str(k): str(v) for k, v in (where or {}).items()}
        reduced: dict[str, Any] = {kind: over.get(kind, {}) for kind in _REDUCED}
        self.rule = CrowdRule(
            rate=(first, second),
            **reduced,
            where=parts,
            constants={str(k): in_si(str(v)) for k, v in (constants or {}).items()},
            order=self.order,
        )
        for own, value in parameters.items():
            self._declare(str(own), value)
        formula_of(self)  # says what is wrong with the formula

    def alone(self) -> FormulaForce:
        """The same law where nobody meets anybody, nor a wall."""
        law, found = formula_of(self), copy.copy(self)
        assert isinstance(self.rule, CrowdRule)

        value = {SMALLEST: "nobody", _LARGEST: "-nobody"}

        def none(over: str) -> dict[str, tuple[str, str]]:
            text = value.get(over, "0")
            return {n: (law.units[f"{self.name}__{n}"], text) for n in getattr(self.rule, over)}

        bare: dict[str, Any] = {over: none(over) for over in _REDUCED}
        found.rule = replace(self.rule, **bare)
        return found


def law_from(name: str, description: Any, **network: Any) -> FormulaLaw | FormulaForce:
    """A law from its entry in a configuration or a checkpoint.

    Raises:
        ConfigError: an entry that is missing or unknown, or a formula that cannot be used.
    """
    if not isinstance(description, Mapping) or not {"parameters", "rate"} <= set(description):
        raise ConfigError(
            "model.law needs parameters and rate, as in {parameters: {v0: 30 m/s, L: 5 m}, "
            "rate: {x: v0*(1 - L/gap)}}"
        )
    check_names("model.name", [name])
    rate = description["rate"]
    people = isinstance(rate, Mapping) and not {"vx", "vy", "y"}.isdisjoint(rate)
    keys = (*_CROWD_KEYS, *_REDUCED) if people else _KEYS
    unknown = sorted(set(map(str, description)) - set(keys))
    if unknown:
        raise ConfigError(
            f"model.law has the unknown entries {', '.join(unknown)}; there are {', '.join(keys)}"
        )
    found = {str(key): value for key, value in description.items()}
    for key in (*_MAPPINGS, *_REDUCED):
        if not isinstance(found.get(key) or {}, Mapping):
            raise ConfigError(f"model.law.{key} must be a mapping of names, as {{v0: 30 m/s}}")
        check_names(f"model.law.{key}", found.get(key) or {})
    if people:
        return FormulaForce(name, **found)
    return FormulaLaw(name, **found, **network)
