"""The effects that a synthetic case can hide: ``traffic/effects.yaml`` and ``crowd/effects.yaml``.

An effect has a ``formula``, its ``coefficients``, and ``fields``: names of the domain's ``Hidden``
with the coefficients that go there, negated after a minus sign. Effects without fields act
elsewhere. A coefficient has a ``unit`` and, where they apply: ``drawn``, the ends of the interval
that it is drawn from (the domain draws those without); ``signed``, it is negative half of the time;
``of_width``, it is a share of the corridor's width; ``size``, the range of its distance from
``neutral`` (by default 0), the value without effect, where strength may rescale it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

Coefficients = dict[str, float]


@dataclass(frozen=True)
class Effect:
    """One hidden effect."""

    formula: str
    coefficients: dict[str, dict[str, Any]]
    fields: dict[str, str] = field(default_factory=dict)

    def draw(self, rng: np.random.Generator, width: float = 1.0) -> Coefficients:
        """Random coefficients of plausible size; ``width`` is that of the corridor, m."""
        values = {}
        for name, entry in self.coefficients.items():
            if "drawn" in entry:
                value = float(rng.uniform(*entry["drawn"])) * (width if "of_width" in entry else 1)
                values[name] = value * (float(rng.choice([-1, 1])) if "signed" in entry else 1)
        return values

    def rescaled(self, values: Coefficients, factor: float) -> Coefficients:
        """The coefficients with the effect's size times ``factor``, as far as its range goes."""
        rescaled = dict(values)
        for name, entry in self.coefficients.items():
            if "size" in entry:
                neutral = entry.get("neutral", 0.0)
                distance = values[name] - neutral
                size = float(np.clip(abs(factor * distance), *entry["size"]))
                rescaled[name] = neutral + float(np.copysign(size, distance))
        return rescaled

    def acting(self, values: Coefficients) -> dict[str, float]:
        """Values of the fields of the equation of motion."""
        return {
            name: -values[source[1:]] if source.startswith("-") else values[source]
            for name, source in self.fields.items()
        }


class Catalogue:
    """What can be hidden in a domain.

    Attributes:
        named: effects of the catalogue of the diagnosis.
        outside: effects that no member of this catalogue can express.
        nuisance: what acts in the variant ``heterogeneous``.
        effects: all of them.
        needs_excitation: effects that uniform motion cannot show.
        pairs: effects that are hidden together.
        near_misses: variant to the effects that are hidden in it.
    """

    def __init__(self, domain: str) -> None:
        path = Path(__file__).with_name(domain) / "effects.yaml"
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        self.named, self.outside, self.nuisance = (
            {name: Effect(**entry) for name, entry in content[key].items()}
            for key in ("catalogue", "outside", "nuisance")
        )
        self.effects = {**self.nuisance, **self.named, **self.outside}
        self.needs_excitation: list[str] = content["needs_excitation"]
        self.pairs: list[list[str]] = content["pairs"]
        self.near_misses: dict[str, list[str]] = content["near_misses"]


CATALOGUES = {domain: Catalogue(domain) for domain in ("traffic", "crowd")}
