"""One hidden truth, fully determined: what is hidden, how strongly, in which data, which seed."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from itertools import product
from typing import Any, NamedTuple

import numpy as np

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

#: Standard deviation of measured positions (m) called low, by domain.
LOW_NOISE = {"traffic": 0.05, "crowd": 0.01}
#: That of the variant ``recording``, m.
RECORDING_NOISE = 0.1

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
        variant: ``plain``; of nulls one of :data:`~benchmarks.synthetic_cases.arms.NULLS`; of
            near misses ``smooth`` or ``heavy_tails``; of faults the kind of fault.
        strength: a key of :data:`STRENGTHS`.
        noise: standard deviation of measured positions, m; None takes :data:`LOW_NOISE`.
        n_sequences: number of runs, which share nothing; each is one sequence, or is cut into
            windows (:meth:`windows`).
        seed: of everything random.

    Raises:
        ConfigError: an unknown domain, arm or strength, a size that makes no sense, or windows of
            data in which something is hidden.
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
        for name, known in (("domain", _SIZES), ("arm", ARMS), ("strength", STRENGTHS)):
            value = getattr(self, name)
            if value not in known:
                raise ConfigError(f"{name}={value}: expected one of {', '.join(known)}")
        object.__setattr__(self, "effects", tuple(self.effects))
        if self.noise is None:
            low = RECORDING_NOISE if self.variant == "recording" else LOW_NOISE[self.domain]
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
    def n_agents(self) -> int:
        """Vehicles, the leader included, or people of a run."""
        return self._size[0]

    @property
    def duration(self) -> float:
        """Of a run, s."""
        return self._size[1]

    @property
    def dt(self) -> float:
        """Sampling interval, s."""
        return self._size[2]

    @property
    def _size(self) -> tuple[int, float, float]:
        return _OWN_SIZES.get(self._kind, _SIZES[self.domain])

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
        if self._kind not in _WINDOWS:
            whole = slice(0, self.n_steps + 1), slice(0, self.n_agents)
            return [Window(name, i, *whole) for i, name in enumerate(self.runs)]
        seconds, agents = _WINDOWS[self._kind]
        length, number = round(seconds / self.dt), round(self.duration / seconds)
        groups, over = divmod(self.n_agents - 1, agents - 1)
        found = []
        for (i, run), w, g in product(enumerate(self.runs), range(number), range(groups)):
            first = g * (agents - 1) + (over if w % 2 else 0)
            name = f"{run}w{w}" + (f"g{g}" if groups > 1 else "")
            samples = slice(w * length, (w + 1) * length)
            found.append(Window(name, i, samples, slice(first, first + agents)))
        return found

    @property
    def n_steps(self) -> int:
        """Steps between the samples of a sequence; one sample more is recorded."""
        return round(self.duration / self.dt)

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
        content = {**self.to_dict(), "n_agents": self.n_agents, "duration": self.duration}
        # the law is drawn; the entry keeps the seeds of earlier versions
        content |= {"dt": self.dt, "law": None}
        del content["strength"], content["noise"]
        text = json.dumps([content, purpose], sort_keys=True).encode()
        return np.random.default_rng(list(hashlib.sha256(text).digest()))


def check_effects(case: Case, known: Iterable[str]) -> None:
    """Refuse effects that a domain does not know.

    Raises:
        ConfigError: names the first unknown one and those that are known.
    """
    names = list(known)
    for effect in case.effects:
        if effect not in names:
            raise ConfigError(
                f"effect {effect} is unknown in {case.domain}, expected some of {', '.join(names)}"
            )
