"""Units of formulas: what goes together, and what is told of what does not."""

from __future__ import annotations

import pytest

from nnode.errors import ConfigError
from nnode.laws.parse import parse
from nnode.laws.units import check, dimension, in_si

UNITS = {
    "a": "m/s²", "b": "m/s^2", "v": "m/s", "v0": "m/s", "s0": "m", "T": "s", "dv": "m/s",
    "gap": "m", "m": "kg", "k": "kg/s²", "w": "*", "n": "1",
}  # fmt: skip


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("a*(1 - (v/v0)**4 - ((s0 + max(0, v*T + v*dv/(2*sqrt(a*b))))/gap)**2)", "m/s²"),
        ("v0*log(gap/s0)", "m/s"),
        ("k*gap/m", "m/s^2"),
        ("(gap/s0)**n", "1"),
        ("w*gap + w", "m/s"),
        ("choose(gap, v, 0)", "m/s"),
        ("v0*(gap/s0)**0.5", "m/s"),
        ("sqrt(gap)*sqrt(s0)", "m"),
    ],
)
def test_what_goes_together(text: str, unit: str) -> None:
    check("it", parse(text), UNITS, unit)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("v0*gap", r"it = v0\*gap has the unit m²/s, expected m/s"),
        ("exp(gap)", r"exp\(gap\): the argument gap of exp has the unit m.*divide by a scale"),
        ("v0 + gap", r"v0 \+ gap puts together v0, .*unit m/s, and gap, .*unit m"),
        ("v0*(1 - gap)", r"1 - gap puts together 1, .*unit 1, and gap, .*unit m"),
        ("max(v, gap)", r"max\(v, gap\) puts together"),
        ("v**n", r"log\(v\): the argument v"),
        ("choose(n, v, gap)", r"puts together v"),
    ],
)
def test_what_does_not(text: str, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        check("it", parse(text), UNITS, "m/s")


def test_quantities() -> None:
    assert in_si("120 km/h") == (pytest.approx(120 / 3.6), "m/s")
    assert in_si("1.5") == (1.5, "1")
    assert dimension("kg/(m s)") == (-1, -1, 1)
    for wrong in ("30 furlongs per", "fast", "os.system('x')"):
        with pytest.raises(ConfigError, match="no quantity"):
            in_si(wrong)
    with pytest.raises(ConfigError, match="no unit"):
        dimension("meters per")
    with pytest.raises(ConfigError, match="not made of"):
        dimension("ampere")
