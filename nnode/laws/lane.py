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

from nnode.laws.expression import Expr, below, const, substitute, symbol, symbols
from nnode.laws.parse import parse
from nnode.laws.units import check

#: Names of a lane, and their units.
UNITS = {
    "x": "m", "x_1": "m", "x_2": "m", "gap": "m", "gap_1": "m",
    "v": "m/s", "v_1": "m/s", "v_2": "m/s", "dv": "m/s", "dx_1": "m/s", "measured": "m/s",
    "length_1": "m", "t": "s", "clock": "s", "second": "1",
}  # fmt: skip
#: Of these the others are made.
_MADE = {
    "gap": symbol("x_1") - symbol("x"),
    "gap_1": symbol("x_2") - symbol("x_1"),
    "dv": symbol("v") - symbol("v_1"),
}
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
        states: name to (unit, rate) of states that the term adds.
        where: name to formula of parts.
        constants: name to (value, unit) of fixed quantities.
        inputs: name to unit of what a vehicle has from the data.
    """

    rate: str = ""
    leader: str = ""
    states: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    where: Mapping[str, str] = field(default_factory=dict)
    constants: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    inputs: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Lane:
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
    """

    order: int
    rates: dict[str, Expr]
    leader: Expr
    law: Expr | None
    owned: dict[str, Any]
    inputs: dict[str, Any]
    units: dict[str, str]
    fixed: dict[str, Expr] = field(default_factory=dict)

    @property
    def top(self) -> str:
        """The state whose rate the law says."""
        return "x" if self.order == 1 else "v"

    @cached_property
    def symbols(self) -> frozenset[str]:
        """Names in the rates."""
        return frozenset(symbols([*self.rates.values(), self.leader]))

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
        return all(node.op != "call" for node in below(self.rates.values()))

    def flat(self) -> Lane:
        """With everything that is made of other quantities written out."""
        made = {**_MADE, "clock": symbol("start") + symbol("t"), **self.fixed}
        if self.order > 1:
            made["dx_1"] = symbol("v_1")
        rates = {state: substitute(rate, made) for state, rate in self.rates.items()}
        return replace(self, rates=rates, leader=substitute(self.leader, made))


def begun(
    name: str, rate: Expr, order: int, leader: Expr, owned: Mapping[str, Any], units: dict[str, str]
) -> Lane:
    """A law alone.

    Raises:
        ConfigError: its unit is not that of a speed (first order) or an acceleration.
    """
    every = {**UNITS, **units}
    check(name, rate, every, "m/s" if order == 1 else "m/s^2")
    rates = {"x": rate} if order == 1 else {"x": symbol("v"), "v": rate}
    return Lane(order, rates, leader, rate, dict(owned), {}, every)


def of_rule(
    name: str,
    rule: Rule,
    order: int,
    parameters: Mapping[str, Expr],
    leader: Expr,
    owned: Mapping[str, Any],
    units: Mapping[str, str],
) -> Lane:
    """A law alone, from text.

    Args:
        parameters: name in the formula to symbol.
        leader: speed of a leader that drives by itself, m/s.
        owned: symbol to what it is.
        units: of the symbols.

    Raises:
        ConfigError: it cannot be read, names what there is not, or its units are wrong.
    """
    fixed, own_units = _constants(name, rule)
    names = {
        **_standard(order),
        **parameters,
        **{k: symbol(f"{name}__{k}") for k in rule.constants},
    }
    for part, formula in rule.where.items():
        names[part] = parse(formula, names)
    found = begun(name, parse(rule.rate, names), order, leader, owned, {**units, **own_units})
    return replace(found, fixed=fixed)


def _constants(name: str, rule: Rule) -> tuple[dict[str, Expr], dict[str, str]]:
    """Symbols of fixed quantities to their numbers, and their units."""
    return (
        {f"{name}__{part}": const(value) for part, (value, _) in rule.constants.items()},
        {f"{name}__{part}": unit for part, (_, unit) in rule.constants.items()},
    )


def _standard(order: int) -> dict[str, Expr]:
    hidden = ("measured", "second", *(_SECOND if order == 1 else ()))
    return {name: symbol(name) for name in UNITS if name not in hidden}


def changed(
    lane: Lane,
    name: str,
    rule: Rule,
    parameters: Mapping[str, Expr],
    owned: Mapping[str, Any],
    units: Mapping[str, str],
    whose: Any = None,
) -> Lane:
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
    for part, (unit, _) in rule.states.items():
        names[part] = symbol(f"{name}__{part}")
        every[f"{name}__{part}"] = unit
    rates, laws = dict(lane.rates), {} if lane.law is None else {"law": lane.law}
    before = {**names, "W": rates[lane.top]}
    for part, formula in rule.where.items():
        before[part] = names[part] = parse(formula, before, laws)

    def finished(part: str, text: str, given: Mapping[str, Expr], unit: str) -> Expr:
        found = parse(text, given, laws)
        check(part, found, every, unit)
        return found

    wanted = "m/s" if lane.order == 1 else "m/s^2"
    for part, (unit, formula) in rule.states.items():
        rates[f"{name}__{part}"] = finished(f"d{part}/dt of {name}", formula, before, f"{unit}/s")
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
    )
