"""One hidden truth, fully determined: what is hidden, how strongly, in which data, which seed."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from nnode.errors import ConfigError

#: Share of the recalibrated model's excess cost that an oracle removes; ``full``: no driver noise.
STRENGTHS: dict[str, float] = {"weak": 0.15, "medium": 0.40, "strong": 0.70, "full": 1.0}

#: Arms of the benchmark, with what is right to say about them.
ARMS: dict[str, str] = {
    "single": "one effect of the catalogue: name it",
    "pair": "two effects of the catalogue: name both",
    "nothing": "nothing hidden: name nothing, except heterogeneity where agents do differ",
    "outside": "an effect that the catalogue lacks: say unknown",
    "near_miss": "an effect of the catalogue in another shape: name it",
    "no_excitation": "an effect that these data cannot show: say that it is not testable",
    "fault": "a fault of the data and nothing else: locate it",
}

#: Standard deviation of measured positions (m) called low, by domain.
LOW_NOISE = {"traffic": 0.05, "crowd": 0.01}

#: Files of a case, in a folder of its own.
TABLE, WALLS, TRUTH = "trajectories.csv", "walls.csv", "truth.json"

#: Agents, seconds and sampling interval (s) of a sequence, by domain.
_SIZES: dict[str, tuple[int, float, float]] = {"traffic": (8, 30.0, 0.2), "crowd": (16, 6.0, 0.1)}


@dataclass(frozen=True, kw_only=True)
class Case:
    """What is generated; equal cases give equal files.

    Attributes:
        domain: ``traffic`` or ``crowd``.
        arm: a key of :data:`ARMS`.
        effects: names of the hidden effects, of the catalogue or outside it.
        variant: ``plain``; of nulls ``white``, ``autocorrelated`` or ``heterogeneous``; of near
            misses ``smooth`` or ``heavy_tails``; of faults the kind of fault.
        strength: a key of :data:`STRENGTHS`.
        noise: standard deviation of measured positions, m; None takes :data:`LOW_NOISE`.
        n_sequences: number of sequences.
        n_agents: vehicles (the leader included) or people of a sequence; 0 takes 8 or 16.
        duration: of a sequence, s; 0 takes 30 or 6.
        dt: sampling interval, s; 0 takes 0.2 or 0.1.
        law: base law of traffic: ``lin`` or ``log``; None draws one, mostly lin.
        seed: of everything random.

    Raises:
        ConfigError: an unknown domain, arm, strength or law, or a size that makes no sense.
    """

    domain: str
    arm: str
    effects: tuple[str, ...] = ()
    variant: str = "plain"
    strength: str = "medium"
    noise: float | None = None
    n_sequences: int = 20
    n_agents: int = 0
    duration: float = 0.0
    dt: float = 0.0
    law: str | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        for name, known in (("domain", _SIZES), ("arm", ARMS), ("strength", STRENGTHS)):
            value = getattr(self, name)
            if value not in known:
                raise ConfigError(f"{name}={value}: expected one of {', '.join(known)}")
        if self.law not in (None, "lin", "log"):
            raise ConfigError(f"law={self.law}: expected lin, log or none to draw one")
        object.__setattr__(self, "effects", tuple(self.effects))
        agents, duration, dt = _SIZES[self.domain]
        defaults: dict[str, Any] = {"n_agents": agents, "duration": duration, "dt": dt}
        for name, value in defaults.items():
            if not getattr(self, name):
                object.__setattr__(self, name, value)
        if self.noise is None:
            object.__setattr__(self, "noise", LOW_NOISE[self.domain])
        if self.n_sequences < 1 or self.n_agents < 3 or self.duration < 2 * self.dt:
            raise ConfigError(
                f"n_sequences={self.n_sequences}, n_agents={self.n_agents}, "
                f"duration={self.duration} s at dt={self.dt} s: expected at least one sequence, "
                "three agents and two steps"
            )
        if self.sigma < 0:
            raise ConfigError(f"noise={self.noise}: expected 0 m or more")

    @property
    def sigma(self) -> float:
        """Standard deviation of measured positions, m."""
        assert self.noise is not None
        return float(self.noise)

    @property
    def names(self) -> list[str]:
        """Names of the sequences, as a tidy table's reader gives them."""
        return [f"{TABLE.removesuffix('.csv')}/s{number:03d}" for number in range(self.n_sequences)]

    @property
    def n_steps(self) -> int:
        """Steps between the samples of a sequence; one sample more is recorded."""
        return round(self.duration / self.dt)

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON."""
        return {**asdict(self), "effects": list(self.effects)}

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> Case:
        """The case that :meth:`to_dict` wrote."""
        return cls(**{**content, "effects": tuple(content["effects"])})

    @property
    def key(self) -> str:
        """Unique among cases, usable as a file name."""
        what = "+".join(self.effects) or "nothing"
        digest = hashlib.sha256(self._canonical()).hexdigest()[:8]
        name = f"{self.domain}-{self.arm}-{what}-{self.variant}-{self.strength}-s{self.seed}"
        return re.sub(r"[^A-Za-z0-9._+-]", "_", name) + f"-{digest}"

    def generator(self, purpose: str) -> np.random.Generator:
        """Random numbers for one purpose; those of other purposes do not shift them.

        Cases that differ in strength or noise alone share their roads, drivers and coefficients,
        so that a map over strength and noise compares like with like.
        """
        content = self.to_dict()
        del content["strength"], content["noise"]
        text = json.dumps([content, purpose], sort_keys=True).encode()
        return np.random.default_rng(list(hashlib.sha256(text).digest()))

    def _canonical(self) -> bytes:
        return json.dumps(self.to_dict(), sort_keys=True).encode()


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
