"""Copies of models with an additional effect, or without some effects."""

from __future__ import annotations

import copy
from collections.abc import Iterable

from nnode.model.effects import Effect
from nnode.model.system import System


def extended(system: System, effect: Effect, *, same_terms: bool = False) -> tuple[System, int]:
    """A copy of a model with an additional effect, and the effect's index among the terms.

    The effect is inserted in the order of the ranks.

    Args:
        same_terms: whether the copy has the model's own terms, which is faster, and not copies.
    """
    kept = list(system.terms) if same_terms else []
    model = copy.deepcopy(system, {id(term): term for term in kept})
    place = len(model.terms)
    for i, term in enumerate(model.terms):
        if isinstance(term, Effect) and term.rank > effect.rank:
            place = i
            break
    model.terms.insert(place, effect)
    return model, place


def with_missing(system: System, effects: Iterable[Effect]) -> System:
    """A copy of a model with those effects that it lacks, with their present values."""
    model = copy.deepcopy(system)
    for effect in effects:
        if effect.name not in {present.name for present in effects_of(model)}:
            model, _ = extended(model, type(effect)(**effect.options()))
    return model


def without(system: System, *names: str) -> System:
    """A copy of a model without the named effects."""
    model = copy.deepcopy(system)
    for name in names:
        del model.terms[place_of(model, name)]
    return model


def place_of(system: System, name: str) -> int:
    """The index of the named effect among the model's terms.

    Raises:
        ValueError: the model has no such effect.
    """
    for i, term in enumerate(system.terms):
        if isinstance(term, Effect) and term.name == name:
            return i
    raise ValueError(f"the model has no effect {name}")


def effects_of(system: System) -> list[Effect]:
    """The effects of a model, in the order of its terms."""
    return [term for term in system.terms if isinstance(term, Effect)]


def omitted_effects(system: System) -> str:
    """The caption's note on the effects that a figure of a model's law omits; empty for none."""
    names = [effect.name for effect in effects_of(system)]
    return f"without {', '.join(names)}" if names else ""
