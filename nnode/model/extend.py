"""A model with one more effect, or without one."""

from __future__ import annotations

import copy

from nnode.model.effects import Effect
from nnode.model.system import System


def extended(system: System, effect: Effect) -> tuple[System, int]:
    """A copy of a model with one more effect, and the effect's place among the terms.

    It stands after the law, among the effects in the order of their ranks.
    """
    found = copy.deepcopy(system)
    place = len(found.terms)
    for i, term in enumerate(found.terms):
        if isinstance(term, Effect) and term.rank > effect.rank:
            place = i
            break
    found.terms.insert(place, effect)
    return found, place


def without(system: System, *names: str) -> System:
    """A copy of a model without the effects of some names."""
    found = copy.deepcopy(system)
    for name in names:
        del found.terms[place_of(found, name)]
    return found


def place_of(system: System, name: str) -> int:
    """Of the effect of a name among the model's terms.

    Raises:
        ValueError: the model has no such effect.
    """
    for i, term in enumerate(system.terms):
        if isinstance(term, Effect) and term.name == name:
            return i
    raise ValueError(f"the model has no effect {name}")


def effects_of(system: System) -> list[Effect]:
    """The effects of a model, in their order."""
    return [term for term in system.terms if isinstance(term, Effect)]


def beside(system: System) -> str:
    """What a figure of a model's law or force alone leaves out, in words; empty: nothing."""
    names = [effect.name for effect in effects_of(system)]
    return f"without {', '.join(names)}" if names else ""
