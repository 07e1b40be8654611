"""The formulas of a whole model: a law, and terms that change it one after another.

A term is described by a :class:`Rule`, and :func:`add_term` adds it to a model. The formulas of a
vehicle in a lane may contain the following names and the term's parameters, parts, constants and
inputs:

==============  ======  =====================================================================
name            unit    meaning
==============  ======  =====================================================================
x, x_1, x_2     m       positions of a vehicle, of the one ahead, of the next one
v, v_1, v_2     m/s     their speeds, in laws of second order
gap, gap_1      m       x_1 - x, x_2 - x_1
dv              m/s     v - v_1
dx_1            m/s     the speed of the vehicle ahead by the whole model
t, clock        s       time since the first sample, and time of the day
dt              s       length of a step, in laws that map one step to the next
length_1        m       length of the vehicle ahead; 0 where no length is known
second          1       1 where there is a second vehicle ahead
measured        m/s     measured speed, for a leader
W               m/s(²)  the rate by the law and the effects before
law(gap=...)            the law without effects, with other quantities in place of its own
==============  ======  =====================================================================

The formulas of a person in a crowd may contain:

==================  ======  =================================================================
name                unit    meaning
==================  ======  =================================================================
x, y, vx, vy        m, m/s  position and velocity; a law of first order has no velocity
goal_x, goal_y      m       the destination
way_x, way_y        1       the direction to it
pace                m/s     preferred speed: measured before the sequence, else at its start
speed, e_x, e_y     m/s, 1  speed and walking direction
t, clock            s       time since the first sample, and time of the day
people, points      1       numbers of people and of wall points
dx, dy, d           m       in sums: own position less the other's, and their distance
n_x, n_y            1       in sums: the direction from the other to the person
dvx, dvy            m/s     in sums over others: own velocity less the other's
other_x, other_y    1       in sums over others: the other's walking direction
name_j              .       in sums over others: the other's input ``name`` from the data
normal_x, normal_y  1       in sums over wall points: the wall's normal into the walkable side
along_x, along_y    m       in sums over walls, where the other is the wall's first end: the
                            vector to its second end
r                   m       the radius of a person, RADIUS where the law has none
force_x, force_y    N       the law's force between two people, and its mass; both with other
mass                kg      quantities in place of their own, as ``force_x(dx=...)``
drive_x, drive_y    m/s²    the acceleration towards the destination
nobody              .       the smallest value over others where there are none: NOBODY
==================  ======  =================================================================

The formula of a smallest value may also contain the law's sums. Its derivative is by the first
person who attains it. It is at most NOBODY. Lengths are ``sqrt(x² + y² + SMOOTHING²)``, so that
directions exist where x and y are 0.
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

#: Largest number of remembered steps of all delayed quantities, each a state of every vehicle. The
#: longest reaction time of the package's laws, 3 s, has 300 steps of 0.01 s.
REMEMBERED = 500
#: Scale at which distances (m) and speeds (m/s) are smoothed, so that their gradient exists at 0.
SMOOTHING = 1e-6
#: Smallest value over no other people, in SI units.
NOBODY = 1e6
#: Radius of a person where the law has none, m.
RADIUS = 0.25
#: The kinds of neighbours that sums run over.
OTHERS, POINTS, WALLS = "others", "points", "walls"
#: Minima and maxima over others; a maximum is computed as the minimum of the negative.
SMALLEST, LARGEST = "smallest", "largest"
#: Entries of a rule that are reduced over others or walls, in the order in which they are read.
REDUCED = (OTHERS, POINTS, WALLS, SMALLEST, LARGEST)


def _units(**names: str) -> dict[str, str]:
    """Name to unit, from lists of the names that share a unit."""
    units = {"one": "1", "metre": "m", "speed": "m/s", "second": "s", "any": "*"}
    return {name: units[unit] for unit, text in names.items() for name in text.split()}


#: Kind of neighbours to the names of its relative quantities in summands.
SEEN = {
    OTHERS: _units(metre="dx dy", speed="dvx dvy"),
    POINTS: _units(metre="dx dy", one="normal_x normal_y"),
    WALLS: _units(metre="dx dy along_x along_y"),
    SMALLEST: _units(metre="dx dy", speed="dvx dvy"),
}
_SEEN = frozenset(name for names in SEEN.values() for name in names)
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
#: Derived quantities of a lane and of a crowd.
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
#: Names that may be called with other quantities, as ``law(gap=...)``.
_CALLED = ("law", "force_x", "force_y", "drive_x", "drive_y")


@dataclass(frozen=True)
class Rule:
    """The formulas by which a term changes a model.

    Attributes:
        rate: in a lane, a law's speed or acceleration, or an effect's new value of ``W``; empty
            if the term does not change followers. In a crowd, both components of the acceleration
            that the term adds, or of the velocity if ``order`` is 1.
        leader: the new value of ``W``, the speed of a leader that drives by the law; empty if
            the term does not change it.
        states: name to (unit, rate, start) of states that the term adds. In laws of first order,
            a start may also contain v, v_1 and v_2, the measured speeds at the first sample.
        delayed: name to (formula, unit, delay) of a formula's earlier value. The delay, s, is
            between 0 and the number of remembered steps. The value before the first sample is
            that at the first sample.
        remembered: number of steps for which delayed quantities are remembered.
        others, points, walls: name to (unit, summand) of sums over the others, over wall points,
            over walls; an empty unit takes that of the summand.
        smallest, largest: name to (unit, formula) of minima and maxima over the others.
        where: name to formula of parts; ``name(dx=...)`` is a part with other quantities in it.
        constants: name to (value, unit) of fixed quantities.
        settings: name to unit of fixed quantities whose values the term gives.
        inputs: name to unit of agents' properties from the data.
        force: the sums over others whose summands effects use as ``force_x`` and ``force_y``.
        drive: whether effects use the rate as ``drive_x`` and ``drive_y``.
        order: for a law, 2 if its rate is an acceleration, 1 if it is a velocity.
    """

    rate: str | Sequence[str] = ""
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
    def calls_law(self) -> bool:
        """Whether a formula is the law with other quantities, ``law(...)``."""
        return "law(" in str(self)

    @property
    def texts(self) -> list[str]:
        """Its formulas, except those of states and delays."""
        summands = (text for over in REDUCED for _, text in getattr(self, over).values())
        rate = (self.rate,) if isinstance(self.rate, str) else self.rate
        return [*rate, *self.where.values(), *summands]


@dataclass(frozen=True, eq=False, kw_only=True)
class Dynamics:
    """A model as formulas. Instances are compared by identity, so that caches can use them.

    Attributes:
        order: 1 if positions are the states of motion, 2 if positions and velocities are.
        sums: kind of neighbours to name and summand; minima have the kind SMALLEST.
        law_quantities: name to formula of the law's quantities for effects: ``law``, ``r``,
            ``mass``, ``force_x`` ...
        owned: symbols of parameters to (name in the model, index, number of axes or None).
        settings: symbols of the terms' fixed quantities to (term, name).
        inputs: symbols of agents' properties from the data to (term, name).
        units: symbol to unit.
        fixed: symbols of constants to their values.
    """

    order: int = 2
    sums: dict[str, dict[str, Expr]] = field(default_factory=dict)
    law_quantities: dict[str, Expr] = field(default_factory=dict)
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
        """The names that a term's formulas may contain."""
        raise NotImplementedError  # pragma: no cover - of a lane or of a crowd

    @cached_property
    def symbols(self) -> frozenset[str]:
        """Symbols in its formulas."""
        return frozenset(symbols(self.outputs))

    @property
    def is_map(self) -> bool:
        """Whether it names ``dt``, the length of a step: a map from one step to the next, which has
        no rates in between."""
        return "dt" in self.symbols

    @cached_property
    def is_formula(self) -> bool:
        """Whether it contains no calls of code."""
        return all(node.op != "call" for node in topological(self.outputs))

    @property
    def depends_on_position(self) -> bool:
        """Whether it depends on positions other than through their differences."""
        raise NotImplementedError  # pragma: no cover - of a lane or of a crowd


@dataclass(frozen=True, eq=False, kw_only=True)
class LaneDynamics(Dynamics):
    """A model of a lane.

    Attributes:
        rates: state to its rate for followers; ``x`` first.
        leader: speed of a leader that drives by the law, m/s.
        starts: added state to its value at the start.
        leader_rates: state to its rate for a leader, if it is not 0; without ``x``.
        chained: state to the symbol of its rate for the vehicle ahead, if formulas contain it.
        linear: states that formulas contain only linearly, which are tangents.
    """

    units: dict[str, str] = field(default_factory=lambda: dict(UNITS))
    rates: dict[str, Expr] = field(default_factory=dict)
    leader: Expr = _ZERO
    starts: dict[str, Expr] = field(default_factory=dict)
    leader_rates: dict[str, Expr] = field(default_factory=dict)
    chained: dict[str, str] = field(default_factory=dict)
    linear: frozenset[str] = frozenset()

    @property
    def top(self) -> str:
        """The state whose rate the law defines."""
        return "x" if self.order == 1 else "v"

    @property
    def law(self) -> Expr | None:
        """The law without effects; None if the model has none."""
        return self.law_quantities.get("law")

    @property
    def outputs(self) -> list[Expr]:
        return [*self.rates.values(), self.leader, *self.leader_rates.values()]

    @property
    def names(self) -> Mapping[str, Expr]:
        hidden = {"measured", *(("v", "v_1", "v_2", "dv") if self.order == 1 else ())}
        names = {name: symbol(name) for name in UNITS if name not in hidden}
        if self.top in self.rates:
            return {**names, "W": self.rates[self.top]}
        del names["second"]  # laws depend on one vehicle ahead
        return names

    @cached_property
    def depends_on_position(self) -> bool:
        """Whether a flat formula depends on positions other than through their differences.

        An added state that starts at a position counts as a position.
        """
        positions = {"x", "x_1", "x_2"}
        start_slopes = dict(
            zip(self.starts, shift_slopes([*self.starts.values()], positions), strict=True)
        )
        positions |= {
            f"{s}{j}"
            for s in start_slopes
            if start_slopes[s].is_number(1)
            for j in ("", "_1", "_2")
        }
        rate_slopes = shift_slopes(self.outputs, positions)
        starts_known = all(
            slope.is_number(0) or slope.is_number(1) for slope in start_slopes.values()
        )
        return not starts_known or not all(slope.is_number(0) for slope in rate_slopes)

    @cached_property
    def ahead(self) -> list[tuple[str, int]]:
        """States of the first and second vehicle ahead in the formulas. Those of the first vehicle
        come first, because :class:`nnode.model.lane_rates.LaneRates` needs them for the second."""
        second = [s for s in self.rates if f"{s}_2" in self.symbols]
        first = [s for s in self.rates if f"{s}_1" in self.symbols or s in second]
        return [*((s, 1) for s in first), *((s, 2) for s in second)]

    def flat(self) -> LaneDynamics:
        """The formulas with derived quantities and constants substituted."""
        made = {**{name: parse(text) for name, text in _LANE.items()}, **self.fixed}
        if self.order > 1:
            made["dx_1"] = symbol("v_1")
        rates = {state: substitute(rate, made) for state, rate in self.rates.items()}
        starts: dict[str, Expr] = {}
        at_start = {**made, "dx_1": symbol("v_1")}
        for state, start in self.starts.items():  # a start may contain the states before it
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
        return [*self.rate, *(s for summands in self.sums.values() for s in summands.values())]

    @property
    def names(self) -> Mapping[str, Expr]:
        return _CROWD_NAMES

    @cached_property
    def depends_on_position(self) -> bool:
        """Whether its formulas depend on positions other than through their differences."""
        slopes = [s for axis in "xy" for s in shift_slopes(self.outputs, {axis, f"goal_{axis}"})]
        return not all(slope.is_number(0) for slope in slopes)

    def flat(self) -> CrowdDynamics:
        """The formulas with constants substituted, and without unused sums."""
        constants = dict(self.fixed)
        for over, summands in self.sums.items():
            for name, formula in summands.items():
                value = substitute(formula, constants)
                if value.is_number() if over == SMALLEST else value.is_number(0):
                    constants[name] = value
        x, y = (substitute(rate, constants) for rate in self.rate)
        smallest = {k: substitute(v, constants) for k, v in self.sums[SMALLEST].items()}
        smallest = {k: v for k, v in smallest.items() if k in symbols([x, y])}
        needed = set(symbols([x, y, *smallest.values()]))
        sums = {
            over: {k: substitute(v, constants) for k, v in summands.items() if k in needed}
            for over, summands in self.sums.items()
        }
        return replace(self, rate=(x, y), sums=sums)

    def swapped(self, summand: Expr) -> Expr:
        """A summand over others with both people exchanged."""
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
    """A model with an additional term: the law of a lane first, terms of a crowd in any order.

    Args:
        name: name of the term, prefix of its states, sums, settings and inputs.
        parameters: name in the formula to symbol. A lane's effects can use the law's parameters.
        owned: see :class:`Dynamics`.
        units: symbol to unit.
        whose: the term that gives the values of settings and inputs.
        functions: networks and code by their names in formulas, see
            :func:`nnode.model.parse.parse`.

    Raises:
        ConfigError: a formula cannot be read, or its units are incompatible.
    """
    reader = _Reader(model, name, rule, parameters, units, functions or {})
    symbol_name = reader.symbol_name
    fixed = {symbol_name[part]: const(value) for part, (value, _) in rule.constants.items()}
    changes: dict[str, Any] = {
        "owned": {**model.owned, **owned},
        "settings": model.settings | {symbol_name[part]: (whose, part) for part in rule.settings},
        "inputs": model.inputs | {symbol_name[part]: (whose, part) for part in rule.inputs},
        "units": reader.units,
        "fixed": model.fixed | fixed,
    }
    if isinstance(model, LaneDynamics):
        return replace(model, **changes, **_in_lane(model, reader, parameters))
    return replace(model, **changes, **_in_crowd(model, reader))


class _Reader:
    """Parses the formulas of one term, with the names that it may use."""

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
        self.symbol_name = {part: f"{name}__{part}" for kind in kinds for part in kind}
        part_units = {part: unit for part, (_, unit) in rule.constants.items()}
        part_units |= {part: unit for part, (unit, *_) in rule.states.items()}
        part_units |= {**rule.settings, **rule.inputs}
        self.units = {**model.units, **units}
        self.units |= {self.symbol_name[part]: unit for part, unit in part_units.items()}
        self.units |= {f"{self.symbol_name[part]}_j": unit for part, unit in rule.inputs.items()}
        self.names = {
            **model.names,
            **{k: v for k, v in model.law_quantities.items() if k != "law"},
            **parameters,
            **{part: symbol(symbol_name) for part, symbol_name in self.symbol_name.items()},
        }
        self.laws = {**{k: v for k, v in model.law_quantities.items() if k in _CALLED}, **functions}
        self.sums = {over: dict(summands) for over, summands in model.sums.items()}
        if rule.of_crowd:
            self.names |= {f"{p}_j": symbol(f"{self.symbol_name[p]}_j") for p in rule.inputs}

    def parts(self, unknown: Collection[str]) -> None:
        """Parse the parts that contain no unknown names."""
        later = set(unknown)
        for part, text in list(self.waiting.items()):
            if later & set(_WORD.findall(text)):
                later.add(part)
            else:
                self.names[part] = formula = parse(text, self.names, self.laws)
                if self.rule.of_crowd:
                    self.laws[part] = formula
                del self.waiting[part]

    def formula(self, label: str, text: str, unit: str, over: str | None = None) -> Expr:
        """Parse a formula, and check its unit and its names."""
        formula = parse(text, self.names, self.laws)
        allowed = SEEN[over] if over else ()
        reduced = set() if over in (None, SMALLEST) else {k for f in self.sums.values() for k in f}
        reduced |= set(self.sums[SMALLEST]) if over == SMALLEST else set()
        for s in symbols([formula]):
            if (s in _SEEN and s not in allowed) or s in reduced:
                raise ConfigError(
                    f"{self.name}: {text} names {s.rpartition('__')[2]}, which there is not in "
                    f"{_PLACE.get(over, f'a sum over {over}')}"
                )
        if unit:
            check(label, formula, self.units, unit)
        return formula


def _in_lane(
    model: LaneDynamics, reader: _Reader, parameters: Mapping[str, Expr]
) -> dict[str, Any]:
    """The attributes of a lane that a term changes."""
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
        state = f"{name}__{part}"
        rates[state] = reader.formula(f"d{part}/dt of {name}", rate, f"{unit}/s")
        reader.names = at_start
        starts[state] = reader.formula(f"{part} of {name} at the start", start, unit)
        reader.names = moving
    if isinstance(rule.rate, str) and rule.rate:
        unit = "m/s" if model.order == 1 else "m/s^2"
        rates[model.top] = reader.formula(name, rule.rate, unit)
    if rule.leader:
        reader.names |= given
        leader = reader.formula(name, rule.leader, "m/s")
    law_quantities = model.law_quantities
    if model.top not in model.rates:  # the term is the law
        law_quantities = {k: v for k, v in parameters.items() if k not in UNITS}
        law_quantities |= {"law": rates[model.top]}
        states = [s for s in ("x", "v") if s in rates]
        rates = {**{s: rates[s] for s in states}, **rates}
    return {"rates": rates, "starts": starts, "leader": leader, "law_quantities": law_quantities}


def _remember(
    reader: _Reader,
    part: str,
    entry: tuple[str, str, str],
    rates: dict[str, Expr],
    starts: dict[str, Expr],
) -> None:
    """Add the states and the name of a delayed quantity.

    State i holds the value i + 1 steps ago: every step moves each value to the next state. Values
    between two states are interpolated linearly.
    """
    text, unit, delay = entry
    current, dt = reader.formula(part, text, unit), symbol("dt")
    wait = reader.formula(f"the delay of {part}", delay, "s")
    total, newer = current, current
    for i in range(reader.rule.remembered):
        state = f"{reader.name}__{part}_{i}"
        reader.units[state], starts[state] = unit, current
        older = symbol(state)
        rates[state] = (newer - older) * reciprocal(dt)
        past = apply("max", (wait - i * dt) * reciprocal(dt), const(0))
        total = total + apply("min", past, const(1)) * (older - newer)
        newer = older
    reader.names[part] = total


def _in_crowd(model: CrowdDynamics, reader: _Reader) -> dict[str, Any]:
    """The attributes of a crowd that a term changes."""
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
            summand_unit = unit_of(summand, reader.units)
            reader.units[label] = unit or ("*" if summand_unit is None else shown(summand_unit))
            sums[target][label] = -summand if over == LARGEST else summand
            made[part] = -symbol(label) if over == LARGEST else symbol(label)
        reader.names |= made
    reader.parts(())
    unit = "m/s^2" if rule.order == 2 else "m/s"
    x, y = (reader.formula(name, text, unit) for text in rule.rate)
    if 1 in (model.order, rule.order):
        _check_first_order(model, reader, [x, y, *(f for s in sums.values() for f in s.values())])
    law_quantities = dict(model.law_quantities)
    if rule.force is not None:
        for axis, part in zip("xy", rule.force, strict=True):
            law_quantities[f"force_{axis}"] = sums[OTHERS][f"{name}__{part}"]
        law_quantities |= {
            part: reader.names[part] for part in ("r", "mass") if part in rule.settings
        }
    if rule.drive:
        law_quantities |= {"drive_x": x, "drive_y": y}
    rate, order = (model.rate[0] + x, model.rate[1] + y), min(model.order, rule.order)
    return {"rate": rate, "sums": sums, "law_quantities": law_quantities, "order": order}


def _check_first_order(model: CrowdDynamics, reader: _Reader, formulas: Sequence[Expr]) -> None:
    """Refuse terms and names that need a law of second order.

    Raises:
        ConfigError: a law of first order has further terms, or contains velocities.
    """
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


def parameter_values(
    terms: Sequence[Any], model: Dynamics, parameters: Mapping[str, Tensor] | None = None
) -> dict[str, Tensor]:
    """Symbol to value of a model's parameters.

    Args:
        terms: the terms of the model, which have the default values.
        parameters: name in the model to value; additional leading axes are kept.
    """
    parameters, values = parameters or {}, {}
    for symbol_name, (name, place, size) in model.owned.items():
        value: Any = parameters.get(name)
        if value is None:
            _, number, path = name.split(".", 2)
            value = terms[int(number)]
            for part in path.split("."):
                value = getattr(value, part)  # may be a tensor in place of a parameter
        values[symbol_name] = (
            value if size is None else value.flatten(value.ndim - size)[..., place]
        )
    return values
