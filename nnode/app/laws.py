"""What laws, forces and effects there are: ``python -m nnode.app.laws``."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping
from typing import Any

from nnode.model.effects import CATALOGUE
from nnode.model.effects.base import Effect
from nnode.model.formula import rule_of
from nnode.model.laws import Law, entries, make_law
from nnode.model.term import Interval, Term
from nnode.model.terms import Rule


def main() -> None:
    """Print every law, force and effect with formula, units and source."""
    print("\n".join(lines()))


def lines() -> Iterator[str]:
    """The catalogue, line by line."""
    yield "Laws of lanes (a law of your own: docs/method.md)"
    laws = [make_law(name) for name in entries()]
    for own in laws:
        if own.domain == "traffic":
            yield from _of(own, "dx/dt = " if own.order == 1 else "dv/dt = ")
    for domain, title in (("traffic", "Effects in lanes; W is what law and effects before say"),
                          ("crowd", "Effects in crowds")):  # fmt: skip
        if domain == "crowd":
            yield "Forces on people"
            for own in laws:
                if own.domain == "crowd":
                    yield from _of(own, "dv/dt = ")
        yield title
        for effect in CATALOGUE.of(domain, every=True):  # type: ignore[arg-type]
            yield from _of(effect(), "W becomes " if domain == "traffic" else "")


def _of(term: Term, left: str) -> Iterator[str]:
    rule = rule_of(term)
    if isinstance(term, Law):
        about = entries()[term.entry]["about"]
    else:
        about = (inspect.getdoc(term) or "").splitlines()[0]
    yield f"  {term.name}: {about}".rstrip()
    if rule is None and term.second is None:
        yield f"    {left if not isinstance(term, Effect) else ''}{term.formula}"
    elif rule is not None:
        yield from _ruled(rule, left)
    if term.second is not None:
        of = "of an acceleration, "
        if rule is not None and rule == term.second:
            yield f"    {of}the same"
        else:
            yield from _ruled(term.second, of + left, rule or Rule())
    for module, names in term.networks.items() if isinstance(term, Law) else ():
        neurons = getattr(term, module).sizes[1]
        yield f"    {', '.join(names)}: {neurons} neurons in one hidden layer, softplus"
    for name, unit in term.units.items():
        yield f"    {name}: {'a number' if unit == '1' else unit}{_bounds(term.bounds.get(name))}"
    if isinstance(term, Law) and term.step is not None:
        yield f"    steps: {term.step}"
    yield f"    source: {term.source}"


def _ruled(rule: Rule, left: str, told: Rule | None = None) -> Iterator[str]:
    """A rule, line by line; parts that are told already are left out."""
    told = told or Rule()
    if rule.of_crowd:
        for axis, text in zip("xy", rule.rate, strict=True):
            yield f"    dv{axis}/dt: + {text}" if rule.order == 2 else f"    d{axis}/dt = {text}"
        for over, what in _REDUCED.items():
            for name, (_, text) in getattr(rule, over).items():
                yield f"    {name} = {what} of {text}"
    else:
        yield f"    {left}{rule.rate}" if rule.rate else f"    a leader's W becomes {rule.leader}"
        for name, (text, _, delay) in rule.delayed.items():
            yield f"    {name} = {text}, {delay} ago (at most {rule.remembered} steps)"
        for name, (_, rate, *start) in rule.states.items():
            begins = f", at the start {start[0]}" if start else ""
            yield f"    d{name}/dt = {rate}{begins}"
    for name, text in _new(rule.where, told.where):
        yield f"    {name} = {text}"
    for name, (value, unit) in _new(rule.constants, told.constants):
        yield f"    {name} = {value:g} {'' if unit == '1' else unit}".rstrip()
    for name, unit in _new(rule.inputs, told.inputs):
        yield f"    {name}: of each agent, from the data{'' if unit == '1' else f' ({unit})'}"


def _new(parts: Mapping[str, Any], told: Mapping[str, Any]) -> list[tuple[str, Any]]:
    return [(name, part) for name, part in parts.items() if told.get(name) != part]


_REDUCED = {
    "others": "sum over others", "points": "sum over wall points", "walls": "sum over walls",
    "smallest": "smallest over others", "largest": "largest over others",
}  # fmt: skip


def _bounds(interval: Interval | None) -> str:
    if interval is None or (interval.low, interval.high) == (-float("inf"), float("inf")):
        return ""
    return f", in [{interval.low:g}, {interval.high:g}]"


if __name__ == "__main__":
    main()
