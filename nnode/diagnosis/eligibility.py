"""Checks whether the engines can diagnose a model and test an effect, before any work begins."""

from __future__ import annotations

import copy

from nnode.errors import ConfigError
from nnode.model.build import add_effects
from nnode.model.effects import Effect, IndividualEffect
from nnode.model.expression import symbols
from nnode.model.extend import effects_of
from nnode.model.system import Crowd, System, Traffic
from nnode.model.terms import SMALLEST


def check_effect(effect: type[Effect]) -> None:
    """Refuse an effect that the engine of its domain cannot test.

    Raises:
        ConfigError: names it and what to do.
    """
    reason = _reason(effect)
    if reason:
        raise ConfigError(
            f"the diagnosis of {_MOTION[effect.domain]} cannot look for {effect.name}: {reason}; "
            f"leave it out with discover.exclude=[{effect.name}], it can still be trained with "
            f"'model.effects=[{{name: {effect.name}}}]'"
        )


def not_offered(effect: type[Effect], system: System, differ: bool = False) -> str:
    """Why an effect is not tested in a model; empty: it is.

    Args:
        differ: whether agents differ in the law's parameters, see
            :func:`~nnode.population.followers.drivers_differ` and
            :func:`~nnode.diagnosis.crowds.people.parameters_differ`.
    """
    if isinstance(system, Crowd) and effect.sets_desired_speed and system.desired != "last":
        return (
            f"with desired={system.desired} everybody has a desired speed already, which the "
            "diagnosis estimates"
        )
    if effect.acts_on == "force" and not effect.finds(system.terms):
        return "the law has no force between people of its own that it could change"
    if effect.of_drivers and differ:
        return "the diagnosis estimates how agents differ together with the law"
    rules = effect.rules.values()
    if differ and rules and all(rule.leader and not rule.rate for rule in rules):
        return "this effect changes leaders only, and the diagnosis takes leaders as measured"
    if system.domain != "traffic" or system.order == 1:
        return ""
    try:
        add_effects(copy.deepcopy(system), [{"name": effect.name}])
    except ConfigError as error:
        return str(error).removeprefix("model.effects: ")
    return ""


def check_model(system: System) -> None:
    """Refuse a model that the engine of its domain cannot simulate.

    Raises:
        ConfigError: names the term and what to do.
    """
    law = system.law_formula if isinstance(system, Crowd) else None
    if law is not None and (law.order == 1 or law.sums[SMALLEST]):
        what = "of first order" if law.order == 1 else "with smallest values over others"
        raise ConfigError(
            f"the diagnosis of crowds cannot simulate a law {what}; it can be trained and "
            "evaluated, but not diagnosed; take another law, such as model=sf"
        )
    lane = system.formula if isinstance(system, Traffic) else None
    added_rates = [] if lane is None else list(lane.rates.values())[lane.order :]
    if "dt" in symbols(added_rates):
        raise ConfigError(
            "the model remembers something step by step, and the diagnosis of lanes takes other "
            "steps; it can be trained and evaluated, but not diagnosed"
        )
    names = [effect.name for effect in effects_of(system)]
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise ConfigError(
            f"the model has the effect {', '.join(repeated)} twice, and a diagnosis tells effects "
            "by their names; leave one out"
        )
    if not any(p.requires_grad and p.numel() for p in system.parameters()):
        raise ConfigError(
            "the model has no parameter that is calibrated, and a diagnosis begins with a "
            "calibration; declare one in its terms"
        )


_MOTION = {"traffic": "lanes", "crowd": "crowds"}


def _reason(effect: type[Effect]) -> str:
    if not issubclass(effect, IndividualEffect):
        return ""
    if effect.remembers():
        return "it has a memory"
    if effect.domain == "crowd":
        return ""
    settings = {name: setting.value for name, setting in effect.settings.items()}
    number = len(effect.directions(settings))
    return "" if number == 1 else f"it has {number} amounts for every driver, expected one"
