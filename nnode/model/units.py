"""Dimensional analysis of formulas.

A dimension consists of the exponents of metre, second and kilogram. The unit ``*`` is any unit, as
of the weights of a network.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from fractions import Fraction
from functools import cache
from typing import Any

from nnode.errors import ConfigError
from nnode.model.expression import Expr, topological
from nnode.model.operations import OPERATIONS
from nnode.model.text import plain

Dimension = tuple[Fraction, Fraction, Fraction]
NONE: Dimension = (Fraction(0), Fraction(0), Fraction(0))
_BASE = ("[length]", "[time]", "[mass]")

# Pint evaluates the text of a quantity, and powers such as 9**9**9 would never end. Only names of
# units may be raised, once each, to one digit. The package's laws need at most m⁴.
#: Largest number of characters of a quantity or unit. The package's laws have at most 11.
LONGEST = 100
_DIGIT = r"[+-]?\d(?:\.\d{1,3})?"
_POWER = rf"(?:\s*(?:\*\*|\^)\s*(?:{_DIGIT}|\(\s*{_DIGIT}\s*\))|[⁺⁻]?[⁰¹²³⁴⁵⁶⁷⁸⁹])(?![\w.]|\s*\()"
_TOKEN = re.compile(
    rf"[A-Za-zµμΩΩÅ%°][A-Za-z0-9_µμ]*(?:{_POWER})?"  # a unit
    r"|(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?(?![\d.])"  # a number
    r"|\*(?!\s*\*)|[/·()\s]"
)
#: Words that Pint reads as powers.
_POWER_WORDS = re.compile(r"squared|cubed|square|cubic|sq\b")
_EXPECTED_UNIT = (
    "expected one such as m/s² or kg/(m s), of names of units, *, / and powers of one digit"
)
#: Largest power of a unit in the parts of a formula.
_HIGHEST_POWER = 1000


def _readable(text: str) -> bool:
    """Whether Pint may evaluate a text, because its length and every power in it are bounded."""
    if len(text) > LONGEST or _POWER_WORDS.search(text):
        return False
    place = len(text) - len(text.lstrip().removeprefix("-"))
    while place < len(text):
        token = _TOKEN.match(text, place)
        if token is None:
            return False
        place = token.end()
    return True


@cache
def _registry() -> Any:
    import pint  # the import takes a third of a second

    return pint.UnitRegistry()


@cache
def dimension(unit: str) -> Dimension | None:
    """The dimension of a unit such as ``m/s²``; None for ``*``.

    Raises:
        ConfigError: the text is not a unit of length, time and mass.
    """
    if unit == "*":
        return None
    if not _readable(unit):
        raise ConfigError(f"{unit[:LONGEST]!r} is no unit; {_EXPECTED_UNIT}")
    try:
        powers = _registry().Unit("dimensionless" if unit == "1" else unit).dimensionality
    except Exception as error:
        raise ConfigError(f"{unit!r} is no unit; {_EXPECTED_UNIT}") from error
    if set(powers) - set(_BASE):
        raise ConfigError(f"the unit {unit} is not made of metre, second and kilogram")
    return _powers(powers)


@cache
def in_si(value: str) -> tuple[float, str]:
    """The value of a quantity such as ``120 km/h`` in SI units, and the SI unit.

    Raises:
        ConfigError: the text is not a number with a unit.
    """
    wrong = (
        f"{value[:LONGEST]!r} is no quantity; expected a finite number and a unit, such as 30 m/s "
        "or 1.2 m/s², with powers of one digit"
    )
    if not _readable(value):
        raise ConfigError(wrong)
    try:
        quantity = _registry().Quantity(value)
        size, unit = float(quantity.to_base_units().magnitude), _powers(quantity.dimensionality)
    except Exception as error:
        raise ConfigError(wrong) from error
    if not math.isfinite(size):
        raise ConfigError(wrong)
    return size, shown(unit)


def _powers(dimensionality: Mapping[str, Any]) -> Dimension:
    """The exponents of metre, second and kilogram."""
    length, time, mass = (Fraction(dimensionality.get(b, 0)).limit_denominator(8) for b in _BASE)
    return length, time, mass


def shown(unit: Dimension) -> str:
    """The SI unit of a dimension as text, such as m/s²."""
    powers = {"kg": unit[2], "m": unit[0], "s": unit[1]}
    over = [_raised(name, power) for name, power in powers.items() if power > 0]
    under = [_raised(name, -power) for name, power in powers.items() if power < 0]
    top = " ".join(over) or "1"
    if not under:
        return top
    return f"{top}/{under[0]}" if len(under) == 1 else f"{top}/({' '.join(under)})"


def _raised(name: str, power: Fraction) -> str:
    whole = {1: "", 2: "²", 3: "³"}
    return name + (whole[int(power)] if power in whole else f"^{float(power):g}")


def unit_of(node: Expr, units: Mapping[str, str]) -> Dimension | None:
    """The dimension of a formula from the units of its symbols; None for any dimension.

    Raises:
        ConfigError: parts of the formula have incompatible units.
    """
    dimensions: dict[Expr, Dimension | None] = {}
    for part in topological([node]):
        dimensions[part] = _dimension_of(part, [dimensions[a] for a in part.args], units)
    return dimensions[node]


def check(name: str, node: Expr, units: Mapping[str, str], wanted: str) -> None:
    """Check that a formula has the unit ``wanted``.

    Raises:
        ConfigError: the formula has another unit, or its parts have incompatible units.
    """
    unit, expected = unit_of(node, units), dimension(wanted)
    if unit is not None and expected is not None and unit != expected and not node.is_number(0):
        raise ConfigError(f"{name} = {plain(node)} has the unit {shown(unit)}, expected {wanted}")


def _dimension_of(
    part: Expr, of: list[Dimension | None], units: Mapping[str, str]
) -> Dimension | None:
    match part.op:
        case "const":
            return NONE
        case "symbol":
            return dimension(units[part.value])
        case "call":
            return None
    operation = OPERATIONS[part.op]
    if operation.alike:
        return _same(part, [(part.args[i], of[i]) for i in operation.alike])
    dimensions = [d for d in of if d is not None]
    if operation.powers:
        if len(dimensions) < len(of):
            return None
        powers = [Fraction(power) for power in operation.powers]
        length, time, mass = (
            sum((power * d for power, d in zip(powers, axis, strict=True)), Fraction(0))
            for axis in zip(*dimensions, strict=True)
        )
        if max(abs(length), abs(time), abs(mass)) > _HIGHEST_POWER:
            raise ConfigError(
                f"{plain(part)} has a unit to a power above {_HIGHEST_POWER}; divide by a "
                "scale of the same unit first"
            )
        return length, time, mass
    if wrong := [d for d in dimensions if d != NONE]:
        argument = plain(part.args[0])
        raise ConfigError(
            f"{plain(part)}: the argument {argument} of {part.op} has the unit {shown(wrong[0])}, "
            "expected a number without one; divide by a scale of the same unit"
        )
    return NONE


def _same(part: Expr, pairs: list[tuple[Expr, Dimension | None]]) -> Dimension | None:
    carried = [(a, unit) for a, unit in pairs if unit is not None and not a.is_number(0)]
    for a, unit in carried[1:]:
        if unit != carried[0][1]:
            raise ConfigError(
                f"{plain(part)} puts together {plain(carried[0][0])}, which has the unit "
                f"{shown(carried[0][1])}, and {plain(a)}, which has the unit {shown(unit)}"
            )
    return carried[0][1] if carried else (None if any(unit is None for _, unit in pairs) else NONE)
