"""Builds models from their options."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from nnode.errors import ConfigError, suggestion, unknown_value
from nnode.model.effects import CATALOGUE
from nnode.model.effects.base import Effect
from nnode.model.effects.own import VARIABLE, load_own
from nnode.model.laws import Law, entries, law_from, make_law
from nnode.model.system import Crowd, System, Traffic

Options = Mapping[str, Any]


def _laws(options: Options, generator: torch.Generator) -> list[Law]:
    """The laws of a model: a user-defined one, or package entries with their options."""
    if options["term"] == "formula":
        network, box = options.get("network"), options.get("box")
        law = law_from(
            str(options["name"]), options["law"], network=network, box=box, generator=generator
        )
        return [law]
    v0 = options.get("v0", 1.0)
    if not (math.isfinite(v0) and v0 > 0):
        raise ConfigError(f"model.v0={v0} must be a positive speed in m/s")
    # checkpoints from before there was an option do not name it
    law_options, catalogue = {**options, "preferred": _desired(options) != "last"}, entries()
    return [
        make_law(
            name,
            generator=generator,
            **{k: law_options[k] for k in catalogue[name]["options"] if k in law_options},
        )
        for name in catalogue[str(options["term"])]["model"]
    ]


def _lane(law: Law, options: Options) -> Traffic:
    leader = str(getattr(options["leader"], "value", options["leader"]))
    if leader == "constant" and law.order == 1 and "v0" not in law.scalars:
        raise ConfigError(
            "model.leader=constant needs a law with a parameter v0, the speed of the first "
            "vehicle; name one, or take model.leader=measured"
        )
    if law.entry and leader == "measured" and not law.names("v0"):
        law.idle("v0")
    return Traffic([law], leader=leader)


def _desired(options: Options) -> str:
    # checkpoints from before there was this option do not name it
    desired = options.get("desired", "last")
    return str(getattr(desired, "value", desired))


def build_model(options: Options, seed: int = 0, dtype: torch.dtype = torch.float64) -> System:
    """Build the model that ``options`` describe (see :mod:`nnode.model.options`).

    Random start values depend only on ``seed``, not on the precision.

    Raises:
        ConfigError: an unknown term, or a value outside what the model allows.
    """
    term, generator = str(options["term"]), torch.Generator().manual_seed(seed)
    terms = [name for name, entry in entries().items() if entry.get("model")] + ["formula"]
    if term not in terms:
        raise unknown_value("model.term", term, terms)
    try:
        laws = _laws(options, generator)
        model: System
        if laws[0].domain == "crowd":
            model = Crowd(laws, options.get("wall_spacing", 0.25), desired=_desired(options))
        else:
            model = _lane(laws[0], options)
    except (ValueError, KeyError) as error:
        raise ConfigError(f"model {options.get('name', term)}: {error}") from error
    add_effects(model, options.get("effects") or [])
    model.to(dtype)
    model.project_()
    return model


def add_effects(model: System, chosen: Sequence[str | Options]) -> None:
    """Add effects of the catalogue to a model, in the order of their ranks.

    Args:
        chosen: per effect its ``name`` and any of its parameters, or only the name.

    Raises:
        ConfigError: the catalogue has no such effect for the model's domain, or the effect has no
            such parameter.
    """
    if chosen:
        load_own()
    if chosen and model.domain == "crowd" and model.order == 1:
        raise ConfigError(
            "model.effects change accelerations of people, and this law is of first order: it "
            "says their velocity; leave them out"
        )
    added = []
    for entry in chosen:
        name, values = _entry(entry)
        names = [effect.name for effect in CATALOGUE.of(model.domain, every=True)]
        if name not in names:
            raise ConfigError(
                f"model.effects: there is no {model.domain} effect {name}, expected one of "
                f"{', '.join(names)}{suggestion(name, names)}; files with effects of your own are "
                f"named in {VARIABLE}"
            )
        try:
            added.append(CATALOGUE.effects[name](**values))
        except (ValueError, TypeError) as error:
            raise ConfigError(f"model.effects: {name}: {error}") from error
    for effect in sorted(added, key=lambda effect: effect.rank):
        _check_order(model, effect)
        model.terms.append(effect)
        if model.domain == "traffic" and model.order > 1:
            try:
                model.formula  # noqa: B018 - raises the error
            except ConfigError as error:
                raise ConfigError(f"model.effects: {effect.name} cannot act: {error}") from error


def _entry(entry: Any) -> tuple[str, dict[str, Any]]:
    """An effect's name and parameters, from any of the three accepted forms."""
    if isinstance(entry, str):
        return entry, {}
    if isinstance(entry, Mapping) and "name" in entry:
        return str(entry["name"]), {str(k): v for k, v in entry.items() if k != "name"}
    if isinstance(entry, Mapping) and len(entry) == 1:
        ((name, values),) = entry.items()
        if isinstance(values, Mapping):
            return str(name), {str(k): v for k, v in values.items()}
    raise ConfigError(
        f"model.effects has the entry {entry!r}, expected a name, a name and its parameters as "
        "{relative_speed: {kappa: 0.3}}, or {name: relative_speed, kappa: 0.3}"
    )


def _check_order(model: System, effect: Effect) -> None:
    """Refuse a lane effect that is not defined for the order of the model.

    Raises:
        ConfigError: the effect changes a speed and the law an acceleration, or conversely.
    """
    if model.domain != "traffic":
        return
    if model.order in effect.rules or not (effect.rules or model.order > 1):
        return
    if model.order > 1:
        names = [e.name for e in CATALOGUE.of("traffic", every=True) if 2 in e.rules]
        raise ConfigError(
            f"model.effects: {effect.name} changes a speed, and this law says an acceleration; "
            f"for those there are {', '.join(names)}"
        )
    raise ConfigError(
        f"model.effects: {effect.name} changes an acceleration, and this law says a speed; "
        "take a law of second order, such as model=idm"
    )
