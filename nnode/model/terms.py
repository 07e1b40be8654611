"""The formulas of a whole model: a law, and terms that change it one after another.

A term describes itself by a :class:`Rule`; :func:`add_term` makes a model with one term more. What
the formulas of a vehicle in a lane may name, beside a term's own parameters, parts, constants and
inputs:

==============  ======  =====================================================================
name            unit    meaning
==============  ======  =====================================================================
x, x_1, x_2     m       positions of a vehicle, of the one ahead, of the next one
v, v_1, v_2     m/s     their speeds, in laws of second order
gap, gap_1      m       x_1 - x, x_2 - x_1
dv              m/s     v - v_1
dx_1            m/s     the speed of the vehicle ahead, as the whole model makes it
t, clock        s       time since the first sample, and time of the day
dt              s       length of a step, in laws that say what holds one step later
length_1        m       length of the vehicle ahead; 0 where no length is known
second          1       1 where there is a second vehicle ahead
measured        m/s     measured speed, for a leader
W               m/s(²)  the rate by the law and the effects before
law(gap=...)            the law alone, with other quantities in place of its own
==============  ======  =====================================================================

What the formulas of a person in a crowd may name:

==================  ======  =================================================================
name                unit    meaning
==================  ======  =================================================================
x, y, vx, vy        m, m/s  position and velocity; a law of first order has no velocity
goal_x, goal_y      m       the destination
way_x, way_y        1       the direction to it
pace                m/s     preferred speed: measured before the sequence, else at its start
speed, e_x, e_y     m/s, 1  speed and walking direction
t, clock            s       time since the first sample, and time of the day
people, points      1       how many people there are, and wall points
dx, dy, d           m       in sums: own position less the other's, and their distance
n_x, n_y            1       in sums: the direction from the other to the person
dvx, dvy            m/s     in sums over others: own velocity less the other's
other_x, other_y    1       in sums over others: the other's walking direction
name_j              .       in sums over others: what the other has from the data
normal_x, normal_y  1       in sums over wall points: the wall's normal into the walkable side
along_x, along_y    m       in sums over walls, where the other is the wall's first end: from
                            there to its second end
r                   m       the radius of a person, RADIUS where the law has none
force_x, force_y    N       the law's force between two people, and its mass; both with other
mass                kg      quantities in place of their own, as ``force_x(dx=...)``
drive_x, drive_y    m/s²    the acceleration towards the destination
nobody              .       the smallest value over others where there are none: NOBODY
==================  ======  =================================================================

The formula of a smallest value may also name the law's sums; its slope is that of the one other
person who attains it, the first of several. It is at most NOBODY. Lengths have the smallest value
``SMOOTHING`` added, so that directions exist where they are 0.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

from torch import Tensor

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
from nnode.model.parse import Part, parse
from nnode.model.units import check, shown, unit_of

#: Most steps that delayed quantities are remembered for, all together: each one is a state of
#: every vehicle. The longest reaction time of the package's laws, 3 s, has 300 steps of 0.01 s.
REMEMBERED = 500
#: Distances (m) and speeds (m/s) are smoothed at this scale, so that their gradient exists at 0.
SMOOTHING = 1e-6
#: Smallest value over nobody, in SI units.
NOBODY = 1e6
#: Radius of a person where the law has none, m.
RADIUS = 0.25
#: What sums run over.
OTHERS, POINTS, WALLS = "others", "points", "walls"
#: What are no sums, but the smallest values over others; the largest is the smallest of the
#: opposite.
SMALLEST, LARGEST = "smallest", "largest"
#: Entries of a rule that are reduced over others or walls, in the order in which they are read.
REDUCED = (OTHERS, POINTS, WALLS, SMALLEST, LARGEST)


def _units(**names: str) -> dict[str, str]:
    """Name to unit, from the names of one unit each."""
    units = {"one": "1", "metre": "m", "speed": "m/s", "second": "s", "any": "*"}
    return {name: units[unit] for unit, text in names.items() for name in text.split()}


#: What a sum's summand sees of what it runs over.
SEEN = {
    OTHERS: _units(metre="dx dy", speed="dvx dvy"),
    POINTS: _units(metre="dx dy", one="normal_x normal_y"),
    WALLS: _units(metre="dx dy along_x along_y"),
    SMALLEST: _units(metre="dx dy", speed="dvx dvy"),
}
_SEEN = frozenset(name for found in SEEN.values() for name in found)
#: Names of a lane, and their units.
UNITS = _units(
    metre="x x_1 x_2 gap gap_1 length_1",
    speed="v v_1 v_2 dv dx_1 measured",
    second="t clock dt",
    one="second",
)
#: Names of a crowd, and their units.
CROWD_UNITS = _units(
    metre="x y goal_x goal_y dx dy along_x along_y small_m r",
    speed="vx vy pace dvx dvy small_v",
    second="t start",
    one="people points normal_x normal_y",
    any="nobody",
)
_LENGTH = "sqrt(({0})*({0}) + ({1})*({1}) + {2}*{2})"
_TO, _WALKS = (
    _LENGTH.format("goal_x - x", "goal_y - y", "small_m"),
    _LENGTH.format("vx", "vy", "small_v"),
)
_APART = _LENGTH.format("dx", "dy", "small_m")
_ITS = _LENGTH.format("vx - dvx", "vy - dvy", "small_v")
#: Names that are made of others, of a lane and of a crowd.
_LANE = {"gap": "x_1 - x", "gap_1": "x_2 - x_1", "dv": "v - v_1", "clock": "start + t"}
_CROWD = {
    "clock": "start + t",
    "way_x": f"(goal_x - x)/{_TO}",
    "way_y": f"(goal_y - y)/{_TO}",
    "speed": _WALKS,
    "e_x": f"vx/{_WALKS}",
    "e_y": f"vy/{_WALKS}",
    "d": _APART,
    "n_x": f"dx/{_APART}",
    "n_y": f"dy/{_APART}",
    "other_x": f"(vx - dvx)/{_ITS}",
    "other_y": f"(vy - dvy)/{_ITS}",
}
_WORD = re.compile(r"[A-Za-z_]\w*")
_ZERO = const(0)
#: What a term of a law can be named by with other quantities in it.
_CALLED = ("law", "force_x", "force_y", "drive_x", "drive_y")


@dataclass(frozen=True)
class Rule:
    """What a term does to a model, as formulas.

    Attributes:
        rate: of a lane: of a law its speed or acceleration, of an effect what becomes of ``W``;
            empty: it does nothing to followers. Of a crowd both components of the acceleration
            that it adds, of the velocity where ``order`` is 1.
        leader: what becomes of the speed of a leader that drives by itself, ``W`` before;
            empty: it stays.
        states: name to (unit, rate, start) of states that the term adds. A start may name v, v_1
            and v_2 in laws of first order as well: measured speeds at the first sample.
        delayed: name to (formula, unit, delay), the formula's value some time ago; the delay
            in s, from none to as many steps as the term remembers. Before the first sample
            it was what it is there.
        remembered: steps that delayed quantities are remembered for.
        others, points, walls: name to (unit, summand) of sums over the others, over wall points,
            over walls; without a unit it is that of the summand.
        smallest, largest: name to (unit, formula) of smallest and largest values over the others.
        where: name to formula of parts; ``name(dx=...)`` is one with other quantities in it.
        constants: name to (value, unit) of fixed quantities.
        settings: name to unit of fixed quantities that each term of the kind has its own of.
        inputs: name to unit of what an agent has from the data.
        force: the sums over others whose summands effects know as ``force_x`` and ``force_y``.
        drive: whether effects know the rate as ``drive_x`` and ``drive_y``.
        order: of a law: 2, its rate is an acceleration, or 1, a velocity.
    """

    rate: str | tuple[str, str] = ""
    leader: str = ""
    states: Mapping[str, tuple[str, str, str]] = field(default_factory=dict)
    delayed: Mapping[str, tuple[str, str, str]] = field(default_factory=dict)
    remembered: int = 0
    others: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    points: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    walls: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    smallest: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    largest: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    where: Mapping[str, str] = field(default_factory=dict)
    constants: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    settings: Mapping[str, str] = field(default_factory=dict)
    inputs: Mapping[str, str] = field(default_factory=dict)
    force: tuple[str, str] | None = None
    drive: bool = False
    order: int = 2

    def __post_init__(self) -> None:
        for kind in ("states", "delayed", *REDUCED, "where", "constants", "settings", "inputs"):
            check_names(kind, getattr(self, kind))
        steps = self.memory - len(self.states)
        if not 0 <= steps <= REMEMBERED:
            raise ConfigError(
                f"remembered: {self.remembered} steps of {len(self.delayed)} delayed quantities "
                f"are {steps} states of every vehicle, expected at most {REMEMBERED}; take a "
                "larger step or a shorter delay"
            )

    @property
    def memory(self) -> int:
        """Number of states that the term adds to each agent."""
        return len(self.states) + len(self.delayed) * self.remembered

    @property
    def of_crowd(self) -> bool:
        """Whether it acts on people; on vehicles otherwise."""
        return not isinstance(self.rate, str)

    @property
    def texts(self) -> list[str]:
        """Its formulas, but for those of states and delays."""
        summands = (text for over in REDUCED for _, text in getattr(self, over).values())
        rate = self.rate if isinstance(self.rate, tuple) else (self.rate,)
        return [*rate, *self.where.values(), *summands]


@dataclass(frozen=True, eq=False, kw_only=True)
class Dynamics:
    """A model as formulas of numbers; equal to itself and no other, for those that keep it.

    Attributes:
        order: 1: positions alone are states of motion; 2: positions and velocities.
        sums: what they run over to name and summand; smallest values stand under SMALLEST.
        known: names that effects know from the law: ``law``, ``r``, ``mass``, ``force_x`` ...
        owned: parameters' symbols to what they are, as the builder named it.
        settings: symbols of fixed quantities to whose they are.
        inputs: what agents have from the data, symbol to whose it is.
        units: of all symbols.
        fixed: symbols of fixed quantities to their numbers.
    """

    order: int = 2
    sums: dict[str, dict[str, Expr]] = field(default_factory=dict)
    known: dict[str, Expr] = field(default_factory=dict)
    owned: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    inputs: dict[str, Any] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    fixed: dict[str, Expr] = field(default_factory=dict)

    @property
    def outputs(self) -> list[Expr]:
        """All its formulas."""
        raise NotImplementedError  # pragma: no cover - of a lane or of a crowd

    @property
    def names(self) -> Mapping[str, Expr]:
        """What a term's formulas may name of the neighbourhood."""
        raise NotImplementedError  # pragma: no cover - of a lane or of a crowd

    @cached_property
    def symbols(self) -> frozenset[str]:
        """Names in its formulas."""
        return frozenset(symbols(self.outputs))

    @cached_property
    def is_formula(self) -> bool:
        """Whether there is no code in it that is no formula."""
        return all(node.op != "call" for node in topological(self.outputs))

    @property
    def names_places(self) -> bool:
        """Whether it depends on positions other than by differences of them."""
        raise NotImplementedError  # pragma: no cover - of a lane or of a crowd


@dataclass(frozen=True, eq=False, kw_only=True)
class LaneDynamics(Dynamics):
    """A model of a lane.

    Attributes:
        rates: state to its rate, of followers; ``x`` first.
        leader: speed of a leader that drives by itself, m/s.
        starts: added state to its value at the start.
        leads: rates of a leader's other states, where they are not 0.
        chained: state to the symbol of its rate of the vehicle ahead, where formulas name it.
        linear: states that formulas do no more with than to add multiples of them: tangents.
    """

    units: dict[str, str] = field(default_factory=lambda: dict(UNITS))
    rates: dict[str, Expr] = field(default_factory=dict)
    leader: Expr = _ZERO
    starts: dict[str, Expr] = field(default_factory=dict)
    leads: dict[str, Expr] = field(default_factory=dict)
    chained: dict[str, str] = field(default_factory=dict)
    linear: frozenset[str] = frozenset()

    @property
    def top(self) -> str:
        """The state whose rate the law says."""
        return "x" if self.order == 1 else "v"

    @property
    def law(self) -> Expr | None:
        """The law alone; None: effects cannot name it."""
        return self.known.get("law")

    @property
    def outputs(self) -> list[Expr]:
        return [*self.rates.values(), self.leader, *self.leads.values()]

    @property
    def names(self) -> Mapping[str, Expr]:
        hidden = {"measured", *(("v", "v_1", "v_2", "dv") if self.order == 1 else ())}
        found = {name: symbol(name) for name in UNITS if name not in hidden}
        if self.top in self.rates:
            return {**found, "W": self.rates[self.top]}
        del found["second"]  # a law looks one vehicle ahead
        return found

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
        return all(node.op != "call" for node in topological(self.rates.values()))

    def flat(self) -> LaneDynamics:
        """With everything that is made of other quantities written out."""
        made = {**{name: parse(text) for name, text in _LANE.items()}, **self.fixed}
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


@dataclass(frozen=True, eq=False, kw_only=True)
class CrowdDynamics(Dynamics):
    """A model of a crowd.

    Attributes:
        rate: both components of the acceleration, of the velocity where ``order`` is 1.
    """

    sums: dict[str, dict[str, Expr]] = field(default_factory=lambda: {over: {} for over in SEEN})
    units: dict[str, str] = field(default_factory=lambda: dict(CROWD_UNITS))
    fixed: dict[str, Expr] = field(
        default_factory=lambda: {
            "small_m": const(SMOOTHING),
            "small_v": const(SMOOTHING),
            "r": const(RADIUS),
            "nobody": const(NOBODY),
        }
    )
    rate: tuple[Expr, Expr] = (_ZERO, _ZERO)

    @property
    def outputs(self) -> list[Expr]:
        return [*self.rate, *(s for found in self.sums.values() for s in found.values())]

    @property
    def names(self) -> Mapping[str, Expr]:
        return _CROWD_NAMES

    @cached_property
    def names_places(self) -> bool:
        """Whether its formulas depend on positions other than by differences of them."""
        slopes = [s for axis in "xy" for s in shift_slopes(self.outputs, {axis, f"goal_{axis}"})]
        return not all(slope.is_number(0) for slope in slopes)

    def flat(self) -> CrowdDynamics:
        """With fixed quantities written as numbers, and without sums that nothing needs."""
        known = dict(self.fixed)
        for over, found in self.sums.items():
            for name, formula in found.items():
                value = substitute(formula, known)
                if value.is_number() if over == SMALLEST else value.is_number(0):
                    known[name] = value
        x, y = (substitute(rate, known) for rate in self.rate)
        smallest = {k: substitute(v, known) for k, v in self.sums[SMALLEST].items()}
        smallest = {k: v for k, v in smallest.items() if k in symbols([x, y])}
        needed = set(symbols([x, y, *smallest.values()]))
        sums = {
            over: {k: substitute(v, known) for k, v in found.items() if k in needed}
            for over, found in self.sums.items()
        }
        return replace(self, rate=(x, y), sums=sums)

    def swapped(self, summand: Expr) -> Expr:
        """A summand over others as the other sees it."""
        away = {name: -symbol(name) for name in SEEN[OTHERS]}
        away |= {v: symbol(v) - symbol(f"d{v}") for v in ("vx", "vy")}
        for name in self.inputs:
            away |= {name: symbol(f"{name}_j"), f"{name}_j": symbol(name)}
        return substitute(summand, away)


_CROWD_NAMES = {
    **{name: symbol(name) for name in CROWD_UNITS if name != "start"},
    **{name: parse(text) for name, text in _CROWD.items()},
}
D = TypeVar("D", LaneDynamics, CrowdDynamics)


def add_term(
    model: D,
    name: str,
    rule: Rule,
    parameters: Mapping[str, Expr],
    owned: Mapping[str, Any],
    units: Mapping[str, str],
    whose: Any = None,
    functions: Mapping[str, Part] | None = None,
) -> D:
    """A model with one term more: the law of a lane first, terms of a crowd in any order.

    Args:
        name: of the term; its states, sums, settings and inputs get it before their own names.
        parameters: name in the formula to symbol; those of a lane's law can be named as well.
        owned: symbol to what it is.
        units: of the symbols.
        whose: who gives the values of settings and inputs.
        functions: networks and code by their names in formulas, see
            :func:`nnode.model.parse.parse`.

    Raises:
        ConfigError: a formula that cannot be read or whose units do not go together.
    """
    reader = _Reader(model, name, rule, parameters, units, functions or {})
    changes: dict[str, Any] = {
        "owned": {**model.owned, **owned},
        "settings": model.settings | {reader.own[part]: (whose, part) for part in rule.settings},
        "inputs": model.inputs | {reader.own[part]: (whose, part) for part in rule.inputs},
        "units": reader.units,
        "fixed": {
            **model.fixed,
            **{reader.own[part]: const(value) for part, (value, _) in rule.constants.items()},
        },
    }
    if isinstance(model, LaneDynamics):
        return replace(model, **changes, **_in_lane(model, reader, parameters))
    return replace(model, **changes, **_in_crowd(model, reader))


class _Reader:
    """Reads the formulas of one term, in the names that it may use."""

    def __init__(
        self,
        model: Dynamics,
        name: str,
        rule: Rule,
        parameters: Mapping[str, Expr],
        units: Mapping[str, str],
        functions: Mapping[str, Part],
    ) -> None:
        self.name, self.rule, self.waiting = name, rule, dict(rule.where)
        kinds = (rule.constants, rule.settings, rule.inputs, rule.states)
        self.own = {part: f"{name}__{part}" for kind in kinds for part in kind}
        own_units = {part: unit for part, (_, unit) in rule.constants.items()}
        own_units |= {part: unit for part, (unit, *_) in rule.states.items()}
        own_units |= {**rule.settings, **rule.inputs}
        self.units = {**model.units, **units}
        self.units |= {self.own[part]: unit for part, unit in own_units.items()}
        self.units |= {f"{self.own[part]}_j": unit for part, unit in rule.inputs.items()}
        self.names = {
            **model.names,
            **{k: v for k, v in model.known.items() if k != "law"},
            **parameters,
            **{part: symbol(own) for part, own in self.own.items()},
        }
        self.laws = {**{k: v for k, v in model.known.items() if k in _CALLED}, **functions}
        self.sums = {over: dict(found) for over, found in model.sums.items()}
        if rule.of_crowd:
            self.names |= {f"{p}_j": symbol(f"{self.own[p]}_j") for p in rule.inputs}

    def parts(self, unknown: Collection[str]) -> None:
        """Take the parts that name nothing unknown."""
        later = set(unknown)
        for part, text in list(self.waiting.items()):
            if later & set(_WORD.findall(text)):
                later.add(part)
            else:
                self.names[part] = found = parse(text, self.names, self.laws)
                if self.rule.of_crowd:
                    self.laws[part] = found
                del self.waiting[part]

    def formula(self, label: str, text: str, unit: str, over: str | None = None) -> Expr:
        """A formula, its unit, and what it may name checked."""
        found = parse(text, self.names, self.laws)
        allowed = SEEN[over] if over else ()
        reduced = set() if over in (None, SMALLEST) else {k for f in self.sums.values() for k in f}
        reduced |= set(self.sums[SMALLEST]) if over == SMALLEST else set()
        for s in symbols([found]):
            if (s in _SEEN and s not in allowed) or s in reduced:
                raise ConfigError(
                    f"{self.name}: {text} names {s.rpartition('__')[2]}, which there is not in "
                    f"{_PLACE.get(over, f'a sum over {over}')}"
                )
        if unit:
            check(label, found, self.units, unit)
        return found


def _in_lane(
    model: LaneDynamics, reader: _Reader, parameters: Mapping[str, Expr]
) -> dict[str, Any]:
    """What a term changes of the rates of vehicles."""
    name, rule = reader.name, reader.rule
    rates, starts, leader = dict(model.rates), dict(model.starts), model.leader
    if model.order > 1:
        rates.setdefault("x", symbol("v"))
    reader.parts(set(rule.delayed))
    for part, entry in rule.delayed.items():
        _remember(reader, part, entry, rates, starts)
    reader.parts(())
    given = {"W": leader, "measured": symbol("measured")}
    moving = reader.names
    at_start = {**{speed: symbol(speed) for speed in ("v", "v_1", "v_2", "dv")}, **moving}
    for part, (unit, rate, start) in rule.states.items():
        own = f"{name}__{part}"
        rates[own] = reader.formula(f"d{part}/dt of {name}", rate, f"{unit}/s")
        reader.names = at_start
        starts[own] = reader.formula(f"{part} of {name} at the start", start, unit)
        reader.names = moving
    if isinstance(rule.rate, str) and rule.rate:
        unit = "m/s" if model.order == 1 else "m/s^2"
        rates[model.top] = reader.formula(name, rule.rate, unit)
    if rule.leader:
        reader.names |= given
        leader = reader.formula(name, rule.leader, "m/s")
    known = model.known
    if model.top not in model.rates:  # it is the law
        known = {k: v for k, v in parameters.items() if k not in UNITS}
        known |= {"law": rates[model.top]}
        states = [s for s in ("x", "v") if s in rates]
        rates = {**{s: rates[s] for s in states}, **rates}
    return {"rates": rates, "starts": starts, "leader": leader, "known": known}


def _remember(
    reader: _Reader,
    part: str,
    entry: tuple[str, str, str],
    rates: dict[str, Expr],
    starts: dict[str, Expr],
) -> None:
    """Add the states that remember a delayed quantity, and its name.

    State i holds the value of i + 1 steps ago: a step hands every value on to the next state, and
    a delay between two of them lies between their values.
    """
    text, unit, delay = entry
    now, dt = reader.formula(part, text, unit), symbol("dt")
    wait = reader.formula(f"the delay of {part}", delay, "s")
    total, newer = now, now
    for i in range(reader.rule.remembered):
        own = f"{reader.name}__{part}_{i}"
        reader.units[own], starts[own] = unit, now
        older = symbol(own)
        rates[own] = (newer - older) * reciprocal(dt)
        past = apply("max", (wait - i * dt) * reciprocal(dt), const(0))
        total = total + apply("min", past, const(1)) * (older - newer)
        newer = older
    reader.names[part] = total


def _in_crowd(model: CrowdDynamics, reader: _Reader) -> dict[str, Any]:
    """What a term changes of the accelerations of people."""
    name, rule, sums = reader.name, reader.rule, reader.sums
    labels = {over: set(getattr(rule, over)) for over in REDUCED}
    for over in REDUCED:
        target = SMALLEST if over == LARGEST else over
        if over in (OTHERS, SMALLEST):
            first = (SMALLEST, LARGEST) if over == SMALLEST else REDUCED
            reader.parts(set().union(*(labels[kind] for kind in first)))
        made: dict[str, Expr] = {}
        for part, (unit, text) in getattr(rule, over).items():
            label = f"{name}__{part}"
            summand = reader.formula(label, text, unit, target)
            own_unit = unit_of(summand, reader.units)
            reader.units[label] = unit or ("*" if own_unit is None else shown(own_unit))
            sums[target][label] = -summand if over == LARGEST else summand
            made[part] = -symbol(label) if over == LARGEST else symbol(label)
        reader.names |= made
    reader.parts(())
    unit = "m/s^2" if rule.order == 2 else "m/s"
    x, y = (reader.formula(name, text, unit) for text in rule.rate)
    if 1 in (model.order, rule.order):
        _check_first_order(model, reader, [x, y, *(f for s in sums.values() for f in s.values())])
    known = dict(model.known)
    if rule.force is not None:
        for axis, part in zip("xy", rule.force, strict=True):
            known[f"force_{axis}"] = sums[OTHERS][f"{name}__{part}"]
        known |= {part: reader.names[part] for part in ("r", "mass") if part in rule.settings}
    if rule.drive:
        known |= {"drive_x": x, "drive_y": y}
    rate, order = (model.rate[0] + x, model.rate[1] + y), min(model.order, rule.order)
    return {"rate": rate, "sums": sums, "known": known, "order": order}


def _check_first_order(model: CrowdDynamics, reader: _Reader, formulas: Sequence[Expr]) -> None:
    """Refuse what goes with accelerations alone."""
    first = all(rate.is_number(0) for rate in model.rate)
    if reader.rule.order == 2 or not first:
        raise ConfigError(
            f"{reader.name}: a law of first order says people's velocity, and nothing else can be "
            "added to it: leave out terms and effects that are accelerations"
        )
    named = sorted({"vx", "vy", "dvx", "dvy"} & set(symbols(formulas)))
    if named:
        raise ConfigError(
            f"{reader.name} is of first order: it says the velocity and cannot name {named[0]} or "
            "what is made of it; write rate: {vx: ..., vy: ...} for a law of second order"
        )


_PLACE: dict[str | None, str] = {
    None: "a rate",
    SMALLEST: "a smallest or largest value over others",
}


def values_of(model: Dynamics, parameters: Mapping[str, Tensor]) -> list[Tensor]:
    """Of the parameters' symbols, in their order, from the model's parameters by name; what stands
    before the parameters' own axes stays."""
    found = []
    for name, place, size in model.owned.values():
        value = parameters[name]
        found.append(value if size is None else value.flatten(value.ndim - size)[..., place])
    return found


def own_values(terms: Sequence[Any], model: Dynamics) -> dict[str, Tensor]:
    """The terms' parameters that a model's formula needs, by their names in the model."""
    found = {}
    for name, _, _ in model.owned.values():
        _, place, path = name.split(".", 2)
        value: Any = terms[int(place)]
        for part in path.split("."):
            value = getattr(value, part)  # may be a tensor in place of a parameter
        found[name] = value
    return found
