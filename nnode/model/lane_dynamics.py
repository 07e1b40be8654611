"""The formula of a whole model of a lane: a law, and effects that change it one after another.

What a formula of a lane may name:

==============  ======  =====================================================================
name            unit    meaning
==============  ======  =====================================================================
x, x_1, x_2     m       places of a vehicle, of the one ahead, of the next one
v, v_1, v_2     m/s     their speeds, in laws of second order
gap, gap_1      m       x_1 - x, x_2 - x_1
dv              m/s     v - v_1
dx_1            m/s     the speed of the vehicle ahead, as the whole model makes it
t, clock        s       time since the first sample, and time of the day
dt              s       length of a step, in laws that say what holds one step later
length_1        m       length of the vehicle ahead; 0 where no length is known
second          1       1 where there is a second vehicle ahead
measured        m/s     measured speed, for a leader
W               m/s(²)  what the law and the effects before say
law(gap=...)            the law alone, with other quantities in place of its own
==============  ======  =====================================================================
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from nnode.errors import ConfigError
from nnode.model.differentiate import shift_slopes
from nnode.model.expression import (
    Expr,
    apply,
    const,
    reciprocal,
    substitute,
    symbol,
    symbols,
    topological,
)
from nnode.model.names import check_names
from nnode.model.parse import parse
from nnode.model.units import check

#: Names of a lane, and their units.
UNITS = {
    "x": "m", "x_1": "m", "x_2": "m", "gap": "m", "gap_1": "m",
    "v": "m/s", "v_1": "m/s", "v_2": "m/s", "dv": "m/s", "dx_1": "m/s", "measured": "m/s",
    "length_1": "m", "t": "s", "clock": "s", "dt": "s", "second": "1",
}  # fmt: skip
#: Of these the others are made.
_MADE = {
    "gap": symbol("x_1") - symbol("x"),
    "gap_1": symbol("x_2") - symbol("x_1"),
    "dv": symbol("v") - symbol("v_1"),
}
#: Most steps that delayed quantities are remembered for, all together: each one is a state of
#: every vehicle. The longest reaction time of the package's laws, 3 s, has 300 steps of 0.01 s.
REMEMBERED = 500
#: Names that exist in laws of second order only.
_SECOND = ("v", "v_1", "v_2", "dv")


@dataclass(frozen=True)
class Rule:
    """What a term does to a model of a lane, as formulas.

    Attributes:
        rate: of a law its speed or acceleration; of an effect what becomes of ``W``; empty:
            it does nothing to followers.
        leader: what becomes of the speed of a leader that drives by itself, ``W`` before;
            empty: it stays.
        states: name to (unit, rate, start) of states that the term adds. A start may name v, v_1
            and v_2 in laws of first order as well: measured speeds at the first sample.
        delayed: name to (formula, unit, delay), the formula's value some time ago; the delay
            in s, from none to as many steps as the term remembers. Before the first sample
            it was what it is there.
        where: name to formula of parts.
        constants: name to (value, unit) of fixed quantities.
        remembered: steps that delayed quantities are remembered for.
        inputs: name to unit of what a vehicle has from the data.
    """

    rate: str = ""
    leader: str = ""
    states: Mapping[str, tuple[str, str, str]] = field(default_factory=dict)
    delayed: Mapping[str, tuple[str, str, str]] = field(default_factory=dict)
    where: Mapping[str, str] = field(default_factory=dict)
    constants: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    remembered: int = 0
    inputs: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for kind in ("states", "delayed", "where", "constants", "inputs"):
            check_names(kind, getattr(self, kind))
        steps = len(self.delayed) * self.remembered
        if not 0 <= steps <= REMEMBERED:
            raise ConfigError(
                f"remembered: {self.remembered} steps of {len(self.delayed)} delayed quantities "
                f"are {steps} states of every vehicle, expected at most {REMEMBERED}; take a "
                "larger step or a shorter delay"
            )

    @property
    def memory(self) -> int:
        """Number of states that the term adds to each vehicle."""
        return len(self.states) + len(self.delayed) * self.remembered


@dataclass(frozen=True, eq=False)
class LaneDynamics:
    """A model of a lane as formulas of numbers; itself and no other, for those that keep it.

    Attributes:
        order: 1: ``x`` alone is a state of motion; 2: ``x`` and ``v``.
        rates: state to its rate, of followers; ``x`` first.
        leader: speed of a leader that drives by itself, m/s.
        law: the law alone; None: effects cannot name it.
        owned: parameters' symbols to what they are, as the builder named it.
        inputs: what vehicles have from the data, symbol to whose it is.
        units: of all symbols.
        fixed: symbols of fixed quantities to their numbers.
        starts: added state to its value at the start.
        leads: rates of a leader's other states, where they are not 0.
        chained: state to the symbol of its rate of the vehicle ahead, where formulas name it.
        linear: states that formulas do no more with than to add multiples of them: tangents.
    """

    order: int
    rates: dict[str, Expr]
    leader: Expr
    law: Expr | None
    owned: dict[str, Any]
    inputs: dict[str, Any]
    units: dict[str, str]
    fixed: dict[str, Expr] = field(default_factory=dict)
    starts: dict[str, Expr] = field(default_factory=dict)
    leads: dict[str, Expr] = field(default_factory=dict)
    chained: dict[str, str] = field(default_factory=dict)
    linear: frozenset[str] = frozenset()

    @property
    def top(self) -> str:
        """The state whose rate the law says."""
        return "x" if self.order == 1 else "v"

    @cached_property
    def symbols(self) -> frozenset[str]:
        """Names in the rates."""
        return frozenset(symbols([*self.rates.values(), self.leader, *self.leads.values()]))

    @cached_property
    def names_places(self) -> bool:
        """Whether a flat formula depends on positions other than by differences of them.

        Added states that start at a position, as what is remembered of the vehicle ahead, are
        positions themselves.
        """
        positions = {"x", "x_1", "x_2"}
        begun = dict(
            zip(self.starts, shift_slopes([*self.starts.values()], positions), strict=True)
        )
        positions |= {f"{s}{j}" for s in begun if begun[s].is_number(1) for j in ("", "_1", "_2")}
        every = shift_slopes([*self.rates.values(), self.leader, *self.leads.values()], positions)
        known = all(slope.is_number(0) or slope.is_number(1) for slope in begun.values())
        return not known or not all(slope.is_number(0) for slope in every)

    @cached_property
    def ahead(self) -> list[tuple[str, int]]:
        """States of the first and second vehicle ahead that the formulas name, the first ones
        first: the second is found by way of them."""
        second = [s for s in self.rates if f"{s}_2" in self.symbols]
        first = [s for s in self.rates if f"{s}_1" in self.symbols or s in second]
        return [*((s, 1) for s in first), *((s, 2) for s in second)]

    @cached_property
    def is_formula(self) -> bool:
        """Whether there is no code in it that is no formula."""
        return all(node.op != "call" for node in topological(self.rates.values()))

    def flat(self) -> LaneDynamics:
        """With everything that is made of other quantities written out."""
        made = {**_MADE, "clock": symbol("start") + symbol("t"), **self.fixed}
        if self.order > 1:
            made["dx_1"] = symbol("v_1")
        rates = {state: substitute(rate, made) for state, rate in self.rates.items()}
        starts: dict[str, Expr] = {}
        at_start = {**made, "dx_1": symbol("v_1")}
        for state, start in self.starts.items():  # one may name those before it
            starts[state] = substitute(substitute(start, at_start), starts)
        lead = substitute(self.leader, made)
        chained = {"x": "dx_1"} if "dx_1" in symbols([*rates.values(), lead]) else {}
        return replace(self, rates=rates, leader=lead, starts=starts, chained=chained)


def base_dynamics(
    name: str, rate: Expr, order: int, leader: Expr, owned: Mapping[str, Any], units: dict[str, str]
) -> LaneDynamics:
    """A law alone.

    Raises:
        ConfigError: its unit is not that of a speed (first order) or an acceleration.
    """
    every = {**UNITS, **units}
    check(name, rate, every, "m/s" if order == 1 else "m/s^2")
    rates = {"x": rate} if order == 1 else {"x": symbol("v"), "v": rate}
    return LaneDynamics(order, rates, leader, rate, dict(owned), {}, every)


def of_rule(
    name: str,
    rule: Rule,
    order: int,
    parameters: Mapping[str, Expr],
    leader: Expr,
    owned: Mapping[str, Any],
    units: Mapping[str, str],
    laws: Mapping[str, Any] | None = None,
) -> LaneDynamics:
    """A law alone, from text.

    Args:
        parameters: name in the formula to symbol.
        leader: speed of a leader that drives by itself, m/s.
        owned: symbol to what it is.
        units: of the symbols.
        laws: networks by their names in the formula, see :func:`nnode.model.parse.parse`.

    Raises:
        ConfigError: it cannot be read, names what there is not, or its units are wrong.
    """
    fixed, own_units = _constants(name, rule)
    names = {
        **_standard(order),
        **parameters,
        **{k: symbol(f"{name}__{k}") for k in rule.constants},
    }
    every = {**UNITS, **units, **own_units}
    for part, (unit, *_) in rule.states.items():
        names[part], every[f"{name}__{part}"] = symbol(f"{name}__{part}"), unit
    states, starts = _delays(name, rule, names, every)
    for part, formula in rule.where.items():
        names[part] = parse(formula, names, laws)
    _add_states(name, rule, names, every, states, starts, laws)
    found = base_dynamics(name, parse(rule.rate, names, laws), order, leader, owned, every)
    return replace(found, fixed=fixed, rates={**found.rates, **states}, starts=starts)


def _add_states(
    name: str, rule: Rule, names: Mapping[str, Expr], units: Mapping[str, str],
    rates: dict[str, Expr], starts: dict[str, Expr], laws: Mapping[str, Any] | None,
) -> None:  # fmt: skip
    """Add rates and starts of a rule's states to those that there are."""
    at_start = {**{v: symbol(v) for v in _SECOND}, **names}
    for part, (unit, rate, start) in rule.states.items():
        own = f"{name}__{part}"
        rates[own] = parse(rate, names, laws)
        check(f"d{part}/dt of {name}", rates[own], units, f"{unit}/s")
        starts[own] = parse(start, at_start, laws)
        check(f"{part} of {name} at the start", starts[own], units, unit)


def _delays(
    name: str,
    rule: Rule,
    names: dict[str, Expr],
    units: dict[str, str],
    laws: Mapping[str, Expr] | None = None,
) -> tuple[dict[str, Expr], dict[str, Expr]]:
    """Rates and starts of the states that remember delayed quantities; adds those to ``names``.

    State i holds the value of i + 1 steps ago: a step hands every value on to the next state, and
    a delay between two of them lies between their values.
    """
    rates, starts, dt = {}, {}, symbol("dt")
    for part, (text, unit, delay) in rule.delayed.items():
        now, wait = parse(text, names, laws), parse(delay, names, laws)
        check(part, now, units, unit)
        check(f"the delay of {part}", wait, units, "s")
        total, newer = now, now
        for i in range(rule.remembered):
            own = f"{name}__{part}_{i}"
            units[own], starts[own] = unit, now
            older = symbol(own)
            rates[own] = (newer - older) * reciprocal(dt)
            past = apply("max", (wait - i * dt) * reciprocal(dt), const(0))
            total = total + apply("min", past, const(1)) * (older - newer)
            newer = older
        names[part] = total
    return rates, starts


def _constants(name: str, rule: Rule) -> tuple[dict[str, Expr], dict[str, str]]:
    """Symbols of fixed quantities to their numbers, and their units."""
    return (
        {f"{name}__{part}": const(value) for part, (value, _) in rule.constants.items()},
        {f"{name}__{part}": unit for part, (_, unit) in rule.constants.items()},
    )


def _standard(order: int) -> dict[str, Expr]:
    hidden = ("measured", "second", *(_SECOND if order == 1 else ()))
    return {name: symbol(name) for name in UNITS if name not in hidden}


def add_effect(
    lane: LaneDynamics,
    name: str,
    rule: Rule,
    parameters: Mapping[str, Expr],
    owned: Mapping[str, Any],
    units: Mapping[str, str],
    whose: Any = None,
) -> LaneDynamics:
    """A model with one effect more.

    Args:
        name: of the effect; its states and inputs get it before their own names.
        parameters: name in the formula to symbol; the law's own can be named as well.
        owned: symbol to what it is.
        units: of the symbols.
        whose: who tells the inputs' values.

    Raises:
        ConfigError: a formula that cannot be read or whose units do not go together.
    """
    every = {**lane.units, **units}
    names: dict[str, Expr] = {**_standard(lane.order), "second": symbol("second")}
    law_names = {s.rpartition("__")[2]: symbol(s) for s in lane.owned}
    names = {**law_names, **names, **parameters}
    fixed, own_units = _constants(name, rule)
    every.update(own_units)
    names.update({part: symbol(f"{name}__{part}") for part in rule.constants})
    inputs = dict(lane.inputs)
    for part, unit in rule.inputs.items():
        own = f"{name}__{part}"
        names[part], every[own], inputs[own] = symbol(own), unit, (whose, part)
    for part, (unit, *_) in rule.states.items():
        names[part] = symbol(f"{name}__{part}")
        every[f"{name}__{part}"] = unit
    rates, laws = dict(lane.rates), {} if lane.law is None else {"law": lane.law}
    before = {**names, "W": rates[lane.top]}
    for part, formula in rule.where.items():
        before[part] = names[part] = parse(formula, before, laws)
    held, starts = _delays(name, rule, before, every, laws)
    rates.update(held)
    starts = {**lane.starts, **starts}

    def finished(part: str, text: str, given: Mapping[str, Expr], unit: str) -> Expr:
        found = parse(text, given, laws)
        check(part, found, every, unit)
        return found

    wanted = "m/s" if lane.order == 1 else "m/s^2"
    _add_states(name, rule, before, every, rates, starts, laws)
    if rule.rate:
        rates[lane.top] = finished(name, rule.rate, before, wanted)
    leader = lane.leader
    if rule.leader:
        given = {**names, "W": leader, "measured": symbol("measured")}
        leader = finished(name, rule.leader, given, "m/s")
    return replace(
        lane,
        rates=rates,
        leader=leader,
        owned={**lane.owned, **owned},
        inputs=inputs,
        units=every,
        fixed={**lane.fixed, **fixed},
        starts=starts,
    )
