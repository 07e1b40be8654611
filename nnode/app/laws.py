"""What laws, forces and effects there are: ``python -m nnode.app.laws``."""

from __future__ import annotations

import inspect
from collections.abc import Iterator

from nnode.data.sequence import Domain
from nnode.model import Linear, Logarithmic, NetworkForce, NetworkSpeed, Relaxation, SocialForce
from nnode.model.effects import CATALOGUE
from nnode.model.field import CAR_FOLLOWING_LAWS, NEURONS
from nnode.model.field_crowd import PEDESTRIAN_LAWS
from nnode.model.formula_law import FormulaForce, FormulaLaw, law_from
from nnode.model.term import Interval, Term, described


def main() -> None:
    """Print every law, force and effect with formula, units and source."""
    print("\n".join(lines()))


def lines() -> Iterator[str]:
    """The catalogue, line by line."""
    yield "Laws of lanes (a law of your own: docs/method.md)"
    for law in (Linear(), Logarithmic(), NetworkSpeed(4)):
        yield from _of(law, "dx/dt = ")
    for name, description in CAR_FOLLOWING_LAWS.items():
        own = law_from(name, description, network=NEURONS.get(name))
        yield from _of(own, "dx/dt = " if own.order == 1 else "dv/dt = ")
    yield "Effects in lanes; W is what law and effects before say"
    yield from _effects("traffic")
    yield "Forces on people"
    for force in (Relaxation(), SocialForce(2.0, 30.0, 9.0), NetworkForce(4)):
        yield from _of(force, "dv/dt = ")
    for name, description in PEDESTRIAN_LAWS.items():
        yield from _of(law_from(name, description), "")
    yield "Effects in crowds"
    yield from _effects("crowd")


def _effects(domain: Domain) -> Iterator[str]:
    for effect in CATALOGUE.of(domain, every=True):
        yield from _printed(effect(), inspect.getdoc(effect), effect.formulas())


def _of(term: Term, left: str) -> Iterator[str]:
    about = None if isinstance(term, FormulaLaw | FormulaForce) else inspect.getdoc(term)
    formulas = [left + term.formula]
    if term.rule is not None and not isinstance(term, NetworkSpeed | NetworkForce):
        formulas = described(term.rule, left)
    if isinstance(term, FormulaLaw) and term.network is not None:
        formulas.append(f"NN: {term.network.sizes[1]} neurons in one hidden layer, softplus")
    yield from _printed(term, about, formulas)


def _printed(term: Term, about: str | None, formulas: list[str]) -> Iterator[str]:
    yield f"  {term.name}: {(about or '').partition(chr(10))[0]}".rstrip()
    for formula in formulas:
        yield f"    {formula}"
    for name, unit in term.units.items():
        yield f"    {name}: {'a number' if unit == '1' else unit}{_bounds(term.bounds.get(name))}"
    if isinstance(term, FormulaLaw) and term.step is not None:
        yield f"    steps: {term.step}"
    yield f"    source: {term.source}"


def _bounds(interval: Interval | None) -> str:
    if interval is None or (interval.low, interval.high) == (-float("inf"), float("inf")):
        return ""
    return f", in [{interval.low:g}, {interval.high:g}]"


if __name__ == "__main__":
    main()
