"""The list of laws, forces and effects: ``python -m nnode.app.laws``."""

from __future__ import annotations

import inspect
from collections.abc import Iterator

from nnode.data.sequence import Domain
from nnode.model.effects import CATALOGUE
from nnode.model.laws import Law, entries, make_law
from nnode.model.term import Interval, Term, described


def main() -> None:
    """Print every law, force and effect with formula, units and source."""
    print("\n".join(lines()))


def lines() -> Iterator[str]:
    """The catalogue, line by line."""
    yield "Laws of lanes (a law of your own: docs/method.md)"
    yield from _laws("traffic")
    yield "Effects in lanes; W is what law and effects before say"
    yield from _effects("traffic")
    yield "Forces on people"
    yield from _laws("crowd")
    yield "Effects in crowds"
    yield from _effects("crowd")


def _effects(domain: Domain) -> Iterator[str]:
    for effect in CATALOGUE.of(domain, every=True):
        yield from _printed(
            effect(), (inspect.getdoc(effect) or "").partition("\n")[0], effect.formula_lines()
        )


def _laws(domain: Domain) -> Iterator[str]:
    for name, entry in entries().items():
        law = make_law(name)
        if law.domain != domain:
            continue
        formulas = described(law.formulas, "dx/dt = " if law.order == 1 else "dv/dt = ")
        for module, names in law.networks.items():
            neurons = getattr(law, module).sizes[1]
            formulas.append(f"{', '.join(names)}: {neurons} neurons in one hidden layer, softplus")
        yield from _printed(law, entry["about"], formulas)


def _printed(term: Term, about: str, formulas: list[str]) -> Iterator[str]:
    yield f"  {term.name}: {about}".rstrip()
    for formula in formulas:
        yield f"    {formula}"
    for name, unit in term.units.items():
        yield f"    {name}: {'a number' if unit == '1' else unit}{_bounds(term.bounds.get(name))}"
    if isinstance(term, Law) and term.step is not None:
        yield f"    steps: {term.step}"
    yield f"    source: {term.source}"


def _bounds(interval: Interval | None) -> str:
    if interval is None or (interval.low, interval.high) == (-float("inf"), float("inf")):
        return ""
    return f", in [{interval.low:g}, {interval.high:g}]"


if __name__ == "__main__":
    main()
