"""The cases of the benchmark: which truths are hidden, arm by arm."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection
from itertools import product
from typing import NamedTuple

from benchmarks.synthetic_cases import faults
from benchmarks.synthetic_cases.case import ARMS, Case
from benchmarks.synthetic_cases.crowd import catalogue as crowd_catalogue
from benchmarks.synthetic_cases.traffic import catalogue as traffic_catalogue
from nnode.errors import ConfigError

#: Kinds of data in which nothing is hidden; ``recording`` is one of traffic, ``slow`` of crowds.
NULLS = ("white", "autocorrelated", "windows", "heterogeneous")

_COMMIT = re.compile(r"[0-9a-f]{40}([0-9a-f]{24})?")

#: Effects that act in different places, times or variables, so that both can be told.
TRAFFIC_PAIRS = (
    ("relative_speed", "speed_zone"),
    ("relative_speed", "multi_anticipation"),
    ("multi_anticipation", "speed_period"),
    ("multi_anticipation", "vehicle_class"),
    ("reaction_delay", "speed_zone"),
    ("inertia", "vehicle_class"),
    ("speed_zone", "speed_period"),
    ("time_gap", "speed_zone"),
    ("free_flow_speed", "vehicle_class"),
)

CROWD_PAIRS = (
    ("drift", "group_cohesion"),
    ("preferred_speed", "wall_repulsion"),
    ("obstacle", "preferred_speed"),
    ("side_preference", "drift"),
    ("alignment", "wall_repulsion"),
    ("group_cohesion", "pair_repulsion"),
    ("attraction", "drift"),
    ("gait_sway", "preferred_speed"),
    ("density_slowdown", "side_preference"),
    ("sliding_friction", "wall_repulsion"),
)


#: Effects and variants of near misses.
_NEAR: dict[str, tuple[tuple[str, str], ...]] = {
    "traffic": (
        ("speed_zone", "smooth"),
        ("speed_period", "smooth"),
        ("relative_speed", "heavy_tails"),
        ("multi_anticipation", "heavy_tails"),
    ),
    "crowd": (
        ("obstacle", "smooth"),
        ("attraction", "smooth"),
        ("group_cohesion", "heavy_tails"),
        ("preferred_speed", "heavy_tails"),
    ),
}
_CATALOGUES = {"traffic": traffic_catalogue, "crowd": crowd_catalogue}


class Hides(NamedTuple):
    """What one case of an arm hides.

    Attributes:
        effects, variant: of the case.
        runs: number of runs, whatever is asked for; 0: as many as are asked for.
    """

    effects: tuple[str, ...] = ()
    variant: str = "plain"
    runs: int = 0


def hides(domain: str, arm: str) -> list[Hides]:
    """What the cases of an arm hide.

    Raises:
        ConfigError: an unknown domain or arm.
    """
    if domain not in _CATALOGUES:
        raise ConfigError(f"domain={domain}: expected one of {', '.join(_CATALOGUES)}")
    if arm not in ARMS:
        raise ConfigError(f"arm={arm}: expected one of {', '.join(ARMS)}")
    catalogue, traffic = _CATALOGUES[domain], domain == "traffic"
    names = {
        "single": catalogue.CATALOGUE,
        "outside": catalogue.OUTSIDE,
        "no_excitation": catalogue.NEEDS_EXCITATION,
    }
    if arm in names:
        return [Hides((name,)) for name in names[arm]]
    if arm == "pair":
        return [Hides(pair) for pair in (TRAFFIC_PAIRS if traffic else CROWD_PAIRS)]
    if arm == "near_miss":
        near = [Hides((name,), variant) for name, variant in _NEAR[domain]]
        return [*near, Hides((), "heavy_tails")]
    if arm == "fault":
        return [Hides((), kind) for kind in faults.KINDS]
    last = Hides((), "recording", runs=2) if traffic else Hides((), "slow")
    return [*(Hides((), variant) for variant in NULLS), last]


def first_seed(commit: str) -> int:
    """The first of the seeds that belong to a commit: nobody can look at their cases before it.

    The first seven hexadecimal digits of the SHA-256 digest of the full hash, as a number.

    Raises:
        ConfigError: no full hash in small letters.
    """
    if not _COMMIT.fullmatch(commit):
        raise ConfigError(
            f"{commit!r} is no full hash of a commit: expected the 40 or 64 characters that "
            "git rev-parse COMMIT prints"
        )
    return int(hashlib.sha256(commit.encode()).hexdigest()[:7], 16)


def cases(
    domain: str,
    arm: str,
    *,
    seeds: Collection[int],
    strengths: Collection[str] = ("medium",),
    noises: Collection[float | None] = (None,),
    sizes: Collection[int] = (20,),
    effects: Collection[str] | None = None,
    variants: Collection[str] | None = None,
) -> list[Case]:
    """Every case of an arm: what it hides × strengths × noise × number of sequences × seeds.

    Strength has no meaning where nothing is hidden or nothing can be seen; such arms come with
    the strength ``full`` only.

    Args:
        noises: standard deviations of measured positions (m); None takes the domain's low one.
        sizes: numbers of runs.
        effects: keeps the cases that hide at least one of these.
        variants: keeps the cases of these variants.

    Raises:
        ConfigError: an unknown domain, arm or strength.
    """
    found = []
    for item in hides(domain, arm):
        if effects is not None and not set(effects) & set(item.effects):
            continue
        if variants is not None and item.variant not in variants:
            continue
        idle = not item.effects or arm == "no_excitation"
        found += [
            Case(
                domain=domain,
                arm=arm,
                effects=item.effects,
                variant=item.variant,
                strength=strength,
                noise=noise,
                n_sequences=size,
                seed=seed,
            )
            for strength, noise, size, seed in product(
                ["full"] if idle else strengths, noises, [item.runs] if item.runs else sizes, seeds
            )
        ]
    return found
