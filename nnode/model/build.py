"""From options to a model."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from difflib import get_close_matches
from typing import Any, cast

import torch

from nnode.data.sequence import Domain
from nnode.errors import ConfigError
from nnode.model.crowd import NetworkForce, Relaxation, SocialForce
from nnode.model.effects import CATALOGUE
from nnode.model.effects.base import Effect
from nnode.model.effects.own import VARIABLE, load_own
from nnode.model.formula_law import FormulaForce, law_from
from nnode.model.system import Crowd, System, Traffic
from nnode.model.term import Term
from nnode.model.traffic import Linear, Logarithmic, NetworkSpeed

Options = Mapping[str, Any]

#: Start values of the social force's parameters, uniform on this interval (section 6.4).
START = (0.0, 50.0)


def _traffic(term: Linear | Logarithmic | NetworkSpeed, options: Options) -> Traffic:
    if not (math.isfinite(options["v0"]) and options["v0"] > 0):
        raise ConfigError(f"model.v0={options['v0']} must be a positive speed in m/s")
    return Traffic([term], leader=str(getattr(options["leader"], "value", options["leader"])))


def _lin(options: Options, generator: torch.Generator) -> System:
    return _traffic(Linear(options["v0"], options["L"], options["L_min"]), options)


def _log(options: Options, generator: torch.Generator) -> System:
    return _traffic(Logarithmic(options["v0"], options["L"], options["L_min"]), options)


def _formula(options: Options, generator: torch.Generator) -> System:
    law = law_from(
        str(options["name"]),
        options["law"],
        network=options.get("network"),
        box=options.get("box"),
        generator=generator,
    )
    if isinstance(law, FormulaForce):
        return _crowd([law], options)
    leader = str(getattr(options["leader"], "value", options["leader"]))
    if leader == "constant" and law.order == 1 and "v0" not in law.scalars:
        raise ConfigError(
            "model.leader=constant needs a law with a parameter v0, the speed of the first "
            "vehicle; name one, or take model.leader=measured"
        )
    return Traffic([law], leader=leader)


def _network_speed(options: Options, generator: torch.Generator) -> System:
    term = NetworkSpeed(options["hidden"], options["v0"], options["box"], generator)
    model = _traffic(term, options)
    if model.leader == "measured":
        term.idle("v0")  # no equation contains it then
    return model


def _social_force(options: Options, generator: torch.Generator) -> System:
    low, high = START
    draw = low + (high - low) * torch.rand(3, generator=generator, dtype=torch.float64)
    start = {
        name: float(value if options[name] is None else options[name])
        for name, value in zip(("A", "k", "kappa"), draw, strict=True)
    }
    term = SocialForce(
        **start,
        r=options["r"],
        B=options["B"],
        mass=options["mass"],
        walls=options["walls"],
        opposing_wall_friction=options["opposing_wall_friction"],
    )
    return _crowd([_drive(options), term], options)


def _network_force(options: Options, generator: torch.Generator) -> System:
    term = NetworkForce(
        options["hidden"],
        mass=options["mass"],
        walls=options["walls"],
        box=options["box"],
        # checkpoints from before there was this option do not name it
        self_interaction=options.get("self_interaction", False),
        generator=generator,
    )
    return _crowd([_drive(options), term], options)


def _desired(options: Options) -> str:
    # checkpoints from before there was this option do not name it
    found = options.get("desired", "last")
    return str(getattr(found, "value", found))


def _drive(options: Options) -> Relaxation:
    """Towards the destination: at the present speed, as the paper's, or at the preferred one."""
    return Relaxation(options["tau"], preferred=_desired(options) != "last")


def _crowd(terms: list[Term], options: Options) -> Crowd:
    return Crowd(terms, options.get("wall_spacing", 0.25), desired=_desired(options))


#: Every calibrated term, by the name that ``model.term`` gives it.
MODELS: dict[str, Callable[[Options, torch.Generator], System]] = {
    "lin": _lin,
    "log": _log,
    "formula": _formula,
    "network_speed": _network_speed,
    "social_force": _social_force,
    "network_force": _network_force,
}


def build_model(options: Options, seed: int = 0, dtype: torch.dtype = torch.float64) -> System:
    """The model that ``options`` describe (see :mod:`nnode.model.options`).

    Random start values depend on ``seed`` alone, in every precision.

    Raises:
        ConfigError: an unknown term, or a value outside what the model allows.
    """
    term = str(options["term"])
    if term not in MODELS:
        near = get_close_matches(term, MODELS, n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise ConfigError(
            f"model.term={term} is unknown, expected one of {', '.join(MODELS)}{hint}"
        )
    try:
        model = MODELS[term](options, torch.Generator().manual_seed(seed))
    except (ValueError, KeyError) as error:
        raise ConfigError(f"model {options.get('name', term)}: {error}") from error
    add_effects(model, options.get("effects") or [])
    model.to(dtype)
    model.project_()
    return model


def add_effects(model: System, chosen: Sequence[str | Options]) -> None:
    """Give a model effects of the catalogue, each in its place in the sum.

    Args:
        chosen: per effect its ``name`` and any of its parameters, or the name alone.

    Raises:
        ConfigError: an effect that the catalogue or the model's domain does not have, or a
            parameter that the effect does not have.
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
        known = [effect.name for effect in CATALOGUE.of(cast(Domain, model.domain), every=True)]
        if name not in known:
            near = get_close_matches(name, known, n=1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise ConfigError(
                f"model.effects: there is no {model.domain} effect {name}, expected one of "
                f"{', '.join(known)}{hint}; files with effects of your own are named in {VARIABLE}"
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
                model.lane  # noqa: B018 - says what the law does not have
            except ConfigError as error:
                raise ConfigError(f"model.effects: {effect.name} cannot act: {error}") from error


def _entry(entry: Any) -> tuple[str, dict[str, Any]]:
    """An effect's name and parameters, in any of the ways to write them."""
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
    """Refuse an effect that is not known for speeds, or for accelerations."""
    if model.domain != "traffic":
        return
    if model.order in effect.rules or not (effect.rules or model.order > 1):
        return
    if model.order > 1:
        known = [e.name for e in CATALOGUE.of("traffic", every=True) if 2 in e.rules]
        raise ConfigError(
            f"model.effects: {effect.name} changes a speed, and this law says an acceleration; "
            f"for those there are {', '.join(known)}"
        )
    raise ConfigError(
        f"model.effects: {effect.name} changes an acceleration, and this law says a speed; "
        "take a law of second order, such as model=idm"
    )
