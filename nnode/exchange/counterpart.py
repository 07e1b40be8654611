"""Parameters of another program, and what of a model that program cannot say."""

from __future__ import annotations

from dataclasses import dataclass, field

from nnode.models import System


@dataclass
class Counterpart:
    """A model as another program's parameters.

    Attributes:
        text: the parameter file.
        notes: how values were made that are not the model's own.
        missing: what of the model has no counterpart, and what that means.
    """

    text: str = ""
    notes: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)


def effects_without(system: System, first: int, counted: set[str]) -> list[str]:
    """A line for each effect that is not ``counted``, of the terms from number ``first`` on."""
    return [
        f"effect {term.name}: {term.formula}"
        for term in list(system.terms)[first:]
        if term.name not in counted
    ]
