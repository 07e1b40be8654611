"""The cases of the benchmark: which truths are hidden, arm by arm."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from dataclasses import dataclass

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
    ("relative_speed", "driver_heterogeneity"),
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


@dataclass(frozen=True)
class Hides:
    """What one case of an arm hides.

    Attributes:
        effects, variant: of the case.
        runs: number of runs, whatever is asked for; 0: as many as are asked for.
    """

    effects: tuple[str, ...] = ()
    variant: str = "plain"
    runs: int = 0


def _traffic() -> dict[str, list[Hides]]:
    return {
        "single": [Hides((name,)) for name in traffic_catalogue.CATALOGUE],
        "pair": [Hides(pair) for pair in TRAFFIC_PAIRS],
        "nothing": [Hides((), variant) for variant in NULLS] + [Hides((), "recording", runs=2)],
        "outside": [Hides((name,)) for name in traffic_catalogue.OUTSIDE],
        "near_miss": [
            Hides(("speed_zone",), "smooth"),
            Hides(("speed_period",), "smooth"),
            Hides(("relative_speed",), "heavy_tails"),
            Hides(("multi_anticipation",), "heavy_tails"),
            Hides((), "heavy_tails"),
        ],
        "no_excitation": [Hides((name,)) for name in traffic_catalogue.NEEDS_EXCITATION],
        "fault": [Hides((), kind) for kind in faults.KINDS],
    }


def _crowd() -> dict[str, list[Hides]]:
    return {
        "single": [Hides((name,)) for name in crowd_catalogue.CATALOGUE],
        "pair": [Hides(pair) for pair in CROWD_PAIRS],
        "nothing": [Hides((), variant) for variant in (*NULLS, "slow")],
        "outside": [Hides((name,)) for name in crowd_catalogue.OUTSIDE],
        "near_miss": [
            Hides(("obstacle",), "smooth"),
            Hides(("attraction",), "smooth"),
            Hides(("group_cohesion",), "heavy_tails"),
            Hides(("preferred_speed",), "heavy_tails"),
            Hides((), "heavy_tails"),
        ],
        "no_excitation": [Hides((name,)) for name in crowd_catalogue.NEEDS_EXCITATION],
        "fault": [Hides((), kind) for kind in faults.KINDS],
    }


_HIDES = {"traffic": _traffic, "crowd": _crowd}


def hides(domain: str, arm: str) -> list[Hides]:
    """What the cases of an arm hide.

    Raises:
        ConfigError: an unknown domain or arm.
    """
    if domain not in _HIDES:
        raise ConfigError(f"domain={domain}: expected one of {', '.join(_HIDES)}")
    if arm not in ARMS:
        raise ConfigError(f"arm={arm}: expected one of {', '.join(ARMS)}")
    return _HIDES[domain]()[arm]


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
    seeds: Iterable[int],
    strengths: Iterable[str] = ("medium",),
    noises: Iterable[float | None] = (None,),
    sizes: Iterable[int] = (20,),
    effects: Iterable[str] | None = None,
    variants: Iterable[str] | None = None,
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
    wanted = None if effects is None else set(effects)
    kept = None if variants is None else set(variants)
    found = []
    seeds, noises, sizes, strengths = list(seeds), list(noises), list(sizes), list(strengths)
    for item in hides(domain, arm):
        if wanted is not None and not wanted & set(item.effects):
            continue
        if kept is not None and item.variant not in kept:
            continue
        idle = not item.effects or arm == "no_excitation"
        for strength in ["full"] if idle else strengths:
            for noise in noises:
                for size in [item.runs] if item.runs else sizes:
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
                        for seed in seeds
                    ]
    return found
