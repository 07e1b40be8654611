"""Cases: what is hidden, how strongly, in which data, with which seed; the cases of each arm."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Collection
from dataclasses import asdict, dataclass
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from benchmarks.synthetic_cases.catalogue import CATALOGUES
from nnode.errors import ConfigError

#: Share of the recalibrated model's excess cost that an oracle removes; ``full``: no driver noise.
STRENGTHS: dict[str, float] = {"weak": 0.15, "medium": 0.40, "strong": 0.70, "full": 1.0}

#: Arms of the benchmark, with what is right to say about them.
ARMS: dict[str, str] = {
    "single": "one effect of the catalogue: name it",
    "pair": "two effects of the catalogue: name both",
    "nothing": "nothing hidden: name nothing, except heterogeneity where people do differ",
    "outside": "an effect that the catalogue lacks: say unknown",
    "near_miss": "an effect of the catalogue in another shape: name it",
    "no_excitation": "an effect that these data cannot show: say that it is not testable",
    "fault": "a fault of the data and nothing else: locate it",
}
#: Kinds of data in which nothing is hidden, and the one that a domain has besides.
NULLS = ("white", "autocorrelated", "windows", "heterogeneous")
_OWN_NULL = {"traffic": "recording", "crowd": "slow"}
#: Kinds of fault, see :mod:`benchmarks.synthetic_cases.faults`.
FAULTS = ("identity_swap", "jump", "overlap")
#: Runs of the variant ``recording``, whatever is asked for, and its noise, m.
_RECORDINGS, _RECORDING_NOISE = 2, 0.1
#: Standard deviation of measured positions (m) called low, by domain.
LOW_NOISE = {"traffic": 0.05, "crowd": 0.01}

#: Files of a case, in a folder of its own.
TABLE, WALLS, TRUTH = "trajectories.csv", "walls.csv", "truth.json"

#: Agents, seconds and sampling interval (s) of a run, by domain, and of variants that differ.
_SIZES: dict[str, tuple[int, float, float]] = {"traffic": (8, 30.0, 0.2), "crowd": (16, 6.0, 0.1)}
_OWN_SIZES = {("traffic", "recording"): (24, 90.0, 0.2), ("crowd", "windows"): (16, 9.0, 0.1)}
#: Seconds and agents of a window, of variants that cut their runs.
_WINDOWS: dict[tuple[str, str], tuple[float, int]] = {
    ("traffic", "windows"): (10.0, 8),
    ("traffic", "recording"): (10.0, 8),
    ("crowd", "windows"): (3.0, 16),
}
_COMMIT = re.compile(r"[0-9a-f]{40}([0-9a-f]{24})?")


class Window(NamedTuple):
    """A sequence of the table: a part of a run, or all of it.

    Attributes:
        name: of the sequence.
        run: its number.
        samples, agents: which of the run's.
    """

    name: str
    run: int
    samples: slice
    agents: slice


@dataclass(frozen=True, kw_only=True)
class Case:
    """What is generated; equal cases give equal files.

    Attributes:
        domain: ``traffic`` or ``crowd``.
        arm: a key of :data:`ARMS`.
        effects: names of the hidden effects, of the catalogue or outside it.
        variant: ``plain``; of nulls one of :data:`NULLS`, of traffic also ``recording``, of crowds
            ``slow``; of near misses ``smooth`` or ``heavy_tails``; of faults the kind of fault.
        strength: a key of :data:`STRENGTHS`.
        noise: standard deviation of measured positions, m; None takes :data:`LOW_NOISE`.
        n_sequences: number of runs, which share nothing; each is one sequence, or is cut into
            windows (:meth:`windows`).
        seed: of everything random.

    Raises:
        ConfigError: an unknown domain, arm, strength or effect, a size that makes no sense, or
            windows of data in which something is hidden.
    """

    domain: str
    arm: str
    effects: tuple[str, ...] = ()
    variant: str = "plain"
    strength: str = "medium"
    noise: float | None = None
    n_sequences: int = 20
    seed: int = 0

    def __post_init__(self) -> None:
        for name, expected in (("domain", _SIZES), ("arm", ARMS), ("strength", STRENGTHS)):
            _check(name, getattr(self, name), expected)
        for effect in self.effects:
            _check(f"{self.domain} effect", effect, CATALOGUES[self.domain].effects)
        object.__setattr__(self, "effects", tuple(self.effects))
        if self.noise is None:
            recording = self.variant == "recording"
            low = _RECORDING_NOISE if recording else LOW_NOISE[self.domain]
            object.__setattr__(self, "noise", low)
        if self.n_sequences < 1:
            raise ConfigError(f"n_sequences={self.n_sequences}: expected at least one")
        if self.sigma < 0:
            raise ConfigError(f"noise={self.noise}: expected 0 m or more")
        if self._kind in _WINDOWS and (self.arm != "nothing" or self.effects):
            raise ConfigError(
                f"variant={self.variant} of arm={self.arm} with {len(self.effects)} effect(s): "
                "expected arm=nothing without effects, as costs of a truth are those of whole runs"
            )

    @property
    def sigma(self) -> float:
        """Standard deviation of measured positions, m."""
        assert self.noise is not None
        return float(self.noise)

    @property
    def _kind(self) -> tuple[str, str]:
        return self.domain, self.variant

    @property
    def size(self) -> tuple[int, float, float]:
        """Vehicles (the leader included) or people, duration (s) and sampling interval (s)."""
        return _OWN_SIZES.get(self._kind, _SIZES[self.domain])

    @property
    def n_steps(self) -> int:
        """Steps between the samples of a run; one sample more is recorded."""
        _, duration, dt = self.size
        return round(duration / dt)

    @property
    def runs(self) -> list[str]:
        """Names of the runs."""
        return [f"s{number:03d}" for number in range(self.n_sequences)]

    @property
    def names(self) -> list[str]:
        """Names of the sequences, as a tidy table's reader gives them."""
        return [f"{TABLE.removesuffix('.csv')}/{window.name}" for window in self.windows()]

    def windows(self) -> list[Window]:
        """The sequences of the table in their order; no sample belongs to two of them.

        Longer runs of vehicles are cut into groups as well. Each shares a vehicle with the one
        ahead, whose last follower leads it, and from one window to the next they move by those
        that are left over: all vehicles of a stream hang together, as in a recording.
        """
        n_agents, duration, dt = self.size
        if self._kind not in _WINDOWS:
            whole = slice(0, self.n_steps + 1), slice(0, n_agents)
            return [Window(name, i, *whole) for i, name in enumerate(self.runs)]
        seconds, agents = _WINDOWS[self._kind]
        length, number = round(seconds / dt), round(duration / seconds)
        groups, over = divmod(n_agents - 1, agents - 1)
        windows = []
        for (i, run), w, g in product(enumerate(self.runs), range(number), range(groups)):
            first = g * (agents - 1) + (over if w % 2 else 0)
            name = f"{run}w{w}" + (f"g{g}" if groups > 1 else "")
            samples = slice(w * length, (w + 1) * length)
            windows.append(Window(name, i, samples, slice(first, first + agents)))
        return windows

    def to_dict(self) -> dict[str, Any]:
        """The arguments, as plain JSON."""
        return {**asdict(self), "effects": list(self.effects)}

    @property
    def key(self) -> str:
        """Unique among cases, usable as a file name."""
        what = "+".join(self.effects) or "nothing"
        content = json.dumps(self.to_dict(), sort_keys=True)
        digest = hashlib.sha256(content.encode()).hexdigest()[:8]
        name = f"{self.domain}-{self.arm}-{what}-{self.variant}-{self.strength}-s{self.seed}"
        return re.sub(r"[^A-Za-z0-9._+-]", "_", name) + f"-{digest}"

    def generator(self, purpose: str) -> np.random.Generator:
        """Random numbers for one purpose; those of other purposes do not shift them.

        Cases that differ in strength or noise alone share their roads, drivers and coefficients,
        so that a map over strength and noise compares like with like.
        """
        n_agents, duration, dt = self.size
        # the law is drawn; the entry keeps the seeds of earlier versions
        content = {**self.to_dict(), "n_agents": n_agents, "duration": duration}
        content |= {"dt": dt, "law": None}
        del content["strength"], content["noise"]
        text = json.dumps([content, purpose], sort_keys=True).encode()
        return np.random.default_rng(list(hashlib.sha256(text).digest()))


def _check(name: str, value: str, expected: Collection[str]) -> None:
    if value not in expected:
        raise ConfigError(f"{name}={value}: expected one of {', '.join(expected)}")


def hidden(domain: str, arm: str) -> list[tuple[tuple[str, ...], str]]:
    """The effects and the variant of each case of an arm.

    Raises:
        ConfigError: an unknown domain or arm.
    """
    _check("domain", domain, CATALOGUES)
    _check("arm", arm, ARMS)
    catalogue = CATALOGUES[domain]
    match arm:
        case "pair":
            return [(tuple(pair), "plain") for pair in catalogue.pairs]
        case "near_miss":
            near = catalogue.near_misses.items()
            cases = [((name,), variant) for variant, names in near for name in names]
            return [*cases, ((), "heavy_tails")]
        case "fault":
            return [((), kind) for kind in FAULTS]
        case "nothing":
            return [((), variant) for variant in (*NULLS, _OWN_NULL[domain])]
    names: Collection[str] = {
        "single": catalogue.named,
        "outside": catalogue.outside,
        "no_excitation": catalogue.needs_excitation,
    }[arm]
    return [((name,), "plain") for name in names]


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
    return [
        Case(
            domain=domain,
            arm=arm,
            effects=names,
            variant=variant,
            strength=strength,
            noise=noise,
            n_sequences=size,
            seed=seed,
        )
        for names, variant in hidden(domain, arm)
        if effects is None or set(effects) & set(names)
        if variants is None or variant in variants
        for strength, noise, size, seed in product(
            strengths if names and arm != "no_excitation" else ["full"],
            noises,
            [_RECORDINGS] if variant == "recording" else sizes,
            seeds,
        )
    ]


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
