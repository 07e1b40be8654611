"""Parameters of another program for a model, and parts of the model without a counterpart."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from nnode.model import System
from nnode.model.laws import CAR_FOLLOWING_LAWS, PEDESTRIAN_LAWS, law_from
from nnode.model.term import Term, short_names

#: Address of a parameter to its interval: ``low`` and ``high``, None where unknown.
Intervals = Mapping[str, Mapping[str, Any]]


@dataclass
class Counterpart:
    """A model as another program's parameters.

    Attributes:
        text: the parameter file.
        notes: explanations of values that are not the model's parameters.
        missing: parts of the model without a counterpart, and the consequences.
        values: parameter of the other program to its text, if it reads such values.
    """

    text: str = ""
    notes: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    values: dict[str, str] = field(default_factory=dict)

    @property
    def lines(self) -> list[str]:
        """The notes, and the missing parts as such."""
        return [*self.notes, *(f"no counterpart: {text}" for text in self.missing)]


def effects_without(system: System, first: int = 1, counted: Collection[str] = ()) -> list[str]:
    """A line for each effect that is not ``counted``, among the terms from index ``first``."""
    return [
        f"effect {term.name}: {term.formula_for(system.order)}"
        for term in system.term_list[first:]
        if term.name not in counted
    ]


def field_law(system: System, names: Iterable[str]) -> str | None:
    """The package's law that a model has, whatever the model's name; None for other laws.

    Args:
        names: names of the compared laws.
    """
    described = {**CAR_FOLLOWING_LAWS, **PEDESTRIAN_LAWS}
    term = system.terms[0] if len(system.terms) else None
    for name in names:
        law = law_from(name, described[name])
        same = type(term) is type(law) and getattr(term, "network", None) is None
        if same and isinstance(term, Term) and (term.rule, term.scalars) == (law.rule, law.scalars):
            return name
    return None


def interval_lines(system: System, intervals: Intervals) -> list[str]:
    """A line for each parameter: its value, and its 95 % interval if known."""
    values = system.physical()
    short, lines = short_names(values), []
    for address, (value, unit) in values.items():
        interval = intervals.get(address, {})
        low, high = interval.get("low"), interval.get("high")
        words = "no interval" if low is None or high is None else f"95 % [{low:.6g}, {high:.6g}]"
        lines.append(f"{short[address]} = {float(value):.6g} {unit}, {words}")
    return lines
