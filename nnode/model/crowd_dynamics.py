"""The formula of a whole model of a crowd: accelerations, or velocities, of sums over others and
over walls, and of smallest values over others.

What a formula of a crowd may name, beside a term's own parameters, parts, constants and inputs:

==================  ======  =================================================================
name                unit    meaning
==================  ======  =================================================================
x, y, vx, vy        m, m/s  a person's place and velocity; a law of first order knows no velocity
goal_x, goal_y      m       his destination
way_x, way_y        1       the direction to it
pace                m/s     his preferred speed: measured before the sequence, else at its start
speed, e_x, e_y     m/s, 1  his speed and walking direction
t, clock            s       time since the first sample, and time of the day
people, points      1       how many people there are, and wall points
dx, dy, d           m       in sums: his place less the other's, and their distance
n_x, n_y            1       in sums: the direction from the other to him
dvx, dvy            m/s     in sums over others: his velocity less the other's
other_x, other_y    1       in sums over others: the other's walking direction
name_j              .       in sums over others: what the other has from the data
normal_x, normal_y  1       in sums over wall points: the wall's normal into the walkable side
along_x, along_y    m       in sums over walls, where the other is the wall's first end: from
                            there to its second end
r                   m       the radius of a person, RADIUS where the law has none
force_x, force_y    N       the law's force between two people, and its mass; both with other
mass                kg      quantities in place of their own, as ``force_x(dx=...)``
drive_x, drive_y    m/s²    what drives a person to his destination
nobody              .       the smallest value over others where there are none: NOBODY
==================  ======  =================================================================

What a smallest value is of may also name the law's sums; its slope is that of the one other person
who attains it, the first of several. It is at most NOBODY. Lengths have the smallest value
``SMOOTHING`` added, so that directions exist where they are 0.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

from nnode.errors import ConfigError
from nnode.model.differentiate import shift_slopes
from nnode.model.expression import Expr, apply, const, substitute, symbol, symbols, topological
from nnode.model.names import check_names
from nnode.model.parse import parse
from nnode.model.units import check, shown, unit_of

#: Distances (m) and speeds (m/s) are smoothed at this scale, so that their gradient exists at 0.
SMOOTHING = 1e-6
#: What sums run over.
OTHERS, POINTS, WALLS = "others", "points", "walls"
#: What are no sums, but the smallest values over others.
SMALLEST = "smallest"
#: The largest is the smallest of the opposite.
_LARGEST = "largest"
#: Smallest value over nobody, in SI units.
NOBODY = 1e6
_OWN = {
    "x": "m", "y": "m", "vx": "m/s", "vy": "m/s", "goal_x": "m", "goal_y": "m", "pace": "m/s",
    "t": "s", "start": "s", "people": "1", "points": "1",
}  # fmt: skip
#: What a sum's summand sees of what it runs over.
SEEN = {
    OTHERS: {"dx": "m", "dy": "m", "dvx": "m/s", "dvy": "m/s"},
    POINTS: {"dx": "m", "dy": "m", "normal_x": "1", "normal_y": "1"},
    WALLS: {"dx": "m", "dy": "m", "along_x": "m", "along_y": "m"},
    SMALLEST: {"dx": "m", "dy": "m", "dvx": "m/s", "dvy": "m/s"},
}
UNITS = {
    **_OWN, **SEEN[OTHERS], **SEEN[POINTS], **SEEN[WALLS],
    "small_m": "m", "small_v": "m/s", "r": "m", "nobody": "*",
}  # fmt: skip
#: Radius of a person where the law has none, m.
RADIUS = 0.25
_FIXED = {
    "small_m": const(SMOOTHING), "small_v": const(SMOOTHING), "r": const(RADIUS),
    "nobody": const(NOBODY),
}  # fmt: skip
#: States that a law of first order does not have.
_VELOCITIES = frozenset({"vx", "vy", "dvx", "dvy"})
_WORD = re.compile(r"[A-Za-z_]\w*")


def _length(a: Expr, b: Expr, small: str) -> Expr:
    return apply("sqrt", a * a + b * b + symbol(small) * symbol(small))


def _names() -> dict[str, Expr]:
    found = {name: symbol(name) for name in UNITS if name != "start"}
    found["clock"] = symbol("start") + symbol("t")
    vx, vy, dx, dy = (symbol(name) for name in ("vx", "vy", "dx", "dy"))
    to_x, to_y = symbol("goal_x") - symbol("x"), symbol("goal_y") - symbol("y")
    far = _length(to_x, to_y, "small_m")
    found["way_x"], found["way_y"] = to_x / far, to_y / far
    found["speed"], found["d"] = _length(vx, vy, "small_v"), _length(dx, dy, "small_m")
    found["e_x"], found["e_y"] = vx / found["speed"], vy / found["speed"]
    found["n_x"], found["n_y"] = dx / found["d"], dy / found["d"]
    to_x, to_y = vx - symbol("dvx"), vy - symbol("dvy")
    pace = _length(to_x, to_y, "small_v")
    found["other_x"], found["other_y"] = to_x / pace, to_y / pace
    return found


@dataclass(frozen=True)
class CrowdRule:
    """What a term does to a model of a crowd, as formulas.

    Attributes:
        rate: both components of the acceleration that it adds, of its sums; of the velocity
            where ``order`` is 1.
        others, points, walls: name to (unit, summand) of sums over the others, over wall points,
            over walls; without a unit it is that of the summand.
        smallest, largest: name to (unit, formula) of smallest and largest values over the others.
        where: name to formula of parts; ``name(dx=...)`` is one with other quantities in it.
        constants: name to (value, unit) of fixed quantities.
        settings: name to unit of fixed quantities that each term of the kind has its own of.
        inputs: name to unit of what a person has from the data.
        force: the sums over others whose summands others know as ``force_x`` and ``force_y``.
        drive: whether others know the rate as ``drive_x`` and ``drive_y``.
        order: 2, or 1.
    """

    rate: tuple[str, str]
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
    memory: ClassVar[int] = 0

    def __post_init__(self) -> None:
        for kind in (*SEEN, _LARGEST, "where", "constants", "settings", "inputs"):
            check_names(kind, getattr(self, kind))


@dataclass(frozen=True, eq=False)
class CrowdDynamics:
    """A model of a crowd as formulas of numbers; itself and no other, for those that keep it.

    Attributes:
        rate: both components of the acceleration, of the velocity where ``order`` is 1.
        sums: what they run over to name and summand; smallest values stand under SMALLEST.
        known: names that terms know from others: ``r``, ``mass``, ``force_x`` ...
        owned: parameters' symbols to what they are, as the builder named it.
        settings: symbols of fixed quantities to what they are.
        inputs: what people have from the data, symbol to whose it is.
        units: of all symbols.
        fixed: symbols of fixed quantities to their numbers.
        order: 2, or 1.
    """

    rate: tuple[Expr, Expr] = (const(0), const(0))
    sums: dict[str, dict[str, Expr]] = field(
        default_factory=lambda: {OTHERS: {}, POINTS: {}, WALLS: {}, SMALLEST: {}}
    )
    known: dict[str, Expr] = field(default_factory=dict)
    owned: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    inputs: dict[str, Any] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=lambda: dict(UNITS))
    fixed: dict[str, Expr] = field(default_factory=lambda: dict(_FIXED))
    order: int = 2

    def flat(self) -> CrowdDynamics:
        """With fixed quantities written as numbers, and without sums that nothing needs."""
        known = dict(self.fixed)
        for over, found in self.sums.items():
            for name, formula in found.items():
                value = substitute(formula, known)
                if value.is_number() if over == SMALLEST else value.is_number(0):
                    known[name] = value
        x, y = (substitute(rate, known) for rate in self.rate)
        least = {k: substitute(v, known) for k, v in self.sums[SMALLEST].items()}
        least = {k: v for k, v in least.items() if k in symbols([x, y])}
        needed = set(symbols([x, y, *least.values()]))
        sums = {
            over: {k: substitute(v, known) for k, v in found.items() if k in needed}
            for over, found in self.sums.items()
        }
        return replace(self, rate=(x, y), sums=sums)

    @property
    def outputs(self) -> list[Expr]:
        """All its formulas."""
        return [*self.rate, *(s for found in self.sums.values() for s in found.values())]

    @cached_property
    def symbols(self) -> frozenset[str]:
        """Names in its formulas."""
        return frozenset(symbols(self.outputs))

    @cached_property
    def names_places(self) -> bool:
        """Whether its formulas depend on positions other than by differences of them."""
        slopes = [s for axis in "xy" for s in shift_slopes(self.outputs, {axis, f"goal_{axis}"})]
        return not all(slope.is_number(0) for slope in slopes)

    @cached_property
    def is_formula(self) -> bool:
        """Whether there is no code in it that is no formula."""
        return all(node.op != "call" for node in topological(self.outputs))

    def swapped(self, summand: Expr) -> Expr:
        """A summand over others as the other sees it."""
        away = {name: -symbol(name) for name in SEEN[OTHERS]}
        away |= {v: symbol(v) - symbol(f"d{v}") for v in ("vx", "vy")}
        for name in self.inputs:
            away |= {name: symbol(f"{name}_j"), f"{name}_j": symbol(name)}
        return substitute(summand, away)


def with_rule(
    law: CrowdDynamics,
    name: str,
    rule: CrowdRule,
    parameters: Mapping[str, Expr],
    owned: Mapping[str, Any],
    units: Mapping[str, str],
    whose: Any = None,
) -> CrowdDynamics:
    """A model with one term more.

    Args:
        name: of the term; its sums, settings and inputs get it before their own names.
        parameters: name in the formula to symbol.
        owned: symbol to what it is.
        units: of the symbols.
        whose: who tells the values of settings and inputs.

    Raises:
        ConfigError: a formula that cannot be read or whose units do not go together.
    """
    own = {part: f"{name}__{part}" for part in (*rule.constants, *rule.settings, *rule.inputs)}
    every = {**law.units, **units}
    every.update({own[part]: unit for part, (_, unit) in rule.constants.items()})
    every.update({own[part]: unit for part, unit in rule.settings.items()})
    every.update({own[part]: unit for part, unit in rule.inputs.items()})
    every.update({f"{own[part]}_j": unit for part, unit in rule.inputs.items()})
    names = {**_NAMES, **law.known, **parameters, **{p: symbol(s) for p, s in own.items()}}
    names.update({f"{part}_j": symbol(f"{own[part]}_j") for part in rule.inputs})
    laws = {k: v for k, v in law.known.items() if k.startswith(("force", "drive"))}
    fixed = {own[part]: const(value) for part, (value, _) in rule.constants.items()}
    sums = {over: dict(found) for over, found in law.sums.items()}
    waiting = dict(rule.where)

    def parts(unknown: Collection[str]) -> None:
        """Take the parts that name nothing unknown."""
        later = set(unknown)
        for part, text in list(waiting.items()):
            if later & set(_WORD.findall(text)):
                later.add(part)
            else:
                names[part] = laws[part] = parse(text, names, laws)
                del waiting[part]

    def finished(part: str, text: str, unit: str, over: str | None) -> Expr:
        found = parse(text, names, laws)
        allowed = SEEN[over] if over else ()
        reduced = set() if over in (None, SMALLEST) else {k for f in sums.values() for k in f}
        reduced |= set(sums[SMALLEST]) if over == SMALLEST else set()
        for s in symbols([found]):
            if (s in _SEEN and s not in allowed) or s in reduced:
                raise ConfigError(
                    f"{name}: {text} names {s.rpartition('__')[2]}, which there is not in "
                    f"{_WHERE[over].format(over)}"
                )
        if unit:
            check(part, found, every, unit)
        return found

    order = law.order if rule.order == 2 else rule.order
    kinds = (OTHERS, POINTS, WALLS, SMALLEST, _LARGEST)
    labels = {over: set(getattr(rule, over)) for over in kinds}
    for over in kinds:
        if over in (OTHERS, SMALLEST):
            least = labels[SMALLEST] | labels[_LARGEST]
            sum_labels = set() if over == SMALLEST else set().union(*labels.values())
            parts(least | sum_labels)
        target = SMALLEST if over == _LARGEST else over
        made: dict[str, Expr] = {}
        for part, (unit, text) in getattr(rule, over).items():
            label = f"{name}__{part}"
            summand = finished(label, text, unit, target)
            own_unit = unit_of(summand, every)
            every[label] = unit or ("*" if own_unit is None else shown(own_unit))
            sums[target][label] = -summand if over == _LARGEST else summand
            made[part] = -symbol(label) if over == _LARGEST else symbol(label)
        names |= made
    parts(())
    unit = "m/s^2" if rule.order == 2 else "m/s"
    rate = [finished(name, text, unit, None) for text in rule.rate]
    if order == 1:
        _of_first_order(
            name, law, rule, [*rate, *(f for found in sums.values() for f in found.values())]
        )
    known = dict(law.known)
    if rule.force is not None:
        for axis, part in zip("xy", rule.force, strict=True):
            known[f"force_{axis}"] = sums[OTHERS][f"{name}__{part}"]
        known |= {part: names[part] for part in ("r", "mass") if part in rule.settings}
    if rule.drive:
        known |= {f"drive_{axis}": part for axis, part in zip("xy", rate, strict=True)}
    return replace(
        law,
        rate=(law.rate[0] + rate[0], law.rate[1] + rate[1]),
        sums=sums,
        known=known,
        owned={**law.owned, **owned},
        settings=law.settings | {own[part]: (whose, part) for part in rule.settings},
        inputs=law.inputs | {own[part]: (whose, part) for part in rule.inputs},
        units=every,
        fixed=law.fixed | fixed,
        order=order,
    )


def _of_first_order(name: str, law: CrowdDynamics, rule: CrowdRule, formulas: list[Expr]) -> None:
    """Refuse what goes with accelerations alone."""
    beside = not (law.rate[0].is_number(0) and law.rate[1].is_number(0))
    if rule.order == 2 or beside:
        raise ConfigError(
            f"{name}: a law of first order says people's velocity, and nothing else can be added "
            "to it: leave out terms and effects that are accelerations"
        )
    named = sorted(_VELOCITIES & set(symbols(formulas)))
    if named:
        raise ConfigError(
            f"{name} is of first order: it says the velocity and cannot name {named[0]} or what "
            "is made of it; write rate: {vx: ..., vy: ...} for a law of second order"
        )


_NAMES = _names()
_SEEN = frozenset(name for found in SEEN.values() for name in found)
_WHERE = {
    None: "a rate", OTHERS: "a sum over {}", POINTS: "a sum over {}", WALLS: "a sum over {}",
    SMALLEST: "a smallest or largest value over others",
}  # fmt: skip
