"""Options of the diagnosis: the dataclass that validates the configuration."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from difflib import get_close_matches

from nnode.data.sequence import Domain
from nnode.diagnosis.eligibility import check_effect
from nnode.errors import ConfigError
from nnode.model.effects import CATALOGUE
from nnode.model.effects.own import VARIABLE


@dataclass
class DiscoverOptions:
    """Options of the diagnosis."""

    confirmation: float = 0.3  # share of the clusters that are used only for the confirmation
    gap: float = 5.0  # s; sequences without identifiers that are closer in time are one cluster
    alpha: float = 0.05  # rate of false alarms over all effects
    seed: int = 0  # seed of the split, of resampling and of a network's start weights
    # names of the effects that are tested; null: all of the catalogue
    effects: list[str] | None = None
    exclude: list[str] = field(default_factory=list)  # names of effects that are not tested
    # models that are compared before effects are tested; null: the domain's laws; []: none
    compare: list[str] | None = None
    # whether positions were smoothed before they were published, so that their errors are
    # autocorrelated and one position per second is used; null: true for known sources of such data
    smoothed: bool | None = None
    max_effects: int = 4  # largest number of added effects
    # whether structure without a named effect is tested; without this test the diagnosis is faster,
    # and its verdict is never "unknown"
    structure: bool = True
    step: float | None = None  # step of the simulations in maps, s; null takes the domain's
    page: bool = True  # report.html with figures, and figures in TensorBoard
    replay: bool = True  # whether the page has a player with the confirmation sequences


def check_options(options: DiscoverOptions, domain: Domain, order: int = 1) -> list[str]:
    """Refuse invalid options.

    Args:
        order: of the law.

    Returns:
        The names of the effects to look for, in the catalogue's order.

    Raises:
        ConfigError: a number outside its range, an effect that the domain's catalogue does
            not have (names the nearest), or one that no engine can look for.
    """
    for name, value in (("confirmation", options.confirmation), ("alpha", options.alpha)):
        if not 0 < value < 1:
            raise ConfigError(f"discover.{name}={value} must lie between 0 and 1")
    if options.max_effects < 0:
        raise ConfigError(f"discover.max_effects={options.max_effects} must be at least 0")
    if options.step is not None and not (math.isfinite(options.step) and options.step > 0):
        raise ConfigError(f"discover.step={options.step} must be a positive number of s, or null")
    available = [effect.name for effect in CATALOGUE.of(domain, order)]
    _known("discover.exclude", options.exclude, available, domain)
    chosen = available
    if options.effects is not None:
        _known("discover.effects", options.effects, available, domain)
        chosen = [name for name in available if name in options.effects]
    names = [name for name in chosen if name not in options.exclude]
    for name in names:
        check_effect(CATALOGUE.effects[name])
    return names


def _known(option: str, names: Iterable[str], available: list[str], domain: Domain) -> None:
    for name in names:
        if name in available:
            continue
        effect = CATALOGUE.effects.get(name)
        if effect is not None:
            raise ConfigError(
                f"{option}: {name} is an effect of {effect.domain} models, the data and the model "
                f"are of {domain}; leave it out"
            )
        matches = get_close_matches(name, available, n=1)
        hint = f"; did you mean {matches[0]}?" if matches else ""
        raise ConfigError(
            f"{option}: there is no {domain} effect {name}, expected some of "
            f"{', '.join(available) or 'none at all'}{hint}; files with effects of your own are "
            f"named in {VARIABLE}"
        )
