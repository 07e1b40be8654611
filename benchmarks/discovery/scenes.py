"""Scenes of SUMO and JuPedSim: ``scenes.yaml``."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

#: By program and name.
SCENES: dict[str, dict[str, dict[str, Any]]] = yaml.safe_load(
    Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8")
)


def generator(name: str, seed: int) -> np.random.Generator:
    """Random numbers of a scene and a seed."""
    return np.random.default_rng(list(hashlib.sha256(f"{name} {seed}".encode()).digest()))


def drawn(rng: np.random.Generator, entry: Mapping[str, Any]) -> dict[str, float]:
    """Values, of which those with two ends are drawn between them."""
    return {
        name: float(value) if isinstance(value, int | float) else float(rng.uniform(*value))
        for name, value in entry.items()
    }
