"""Simulations of the same sequences side by side, as if each were one of its own."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import torch
from torch import Tensor

from nnode.model.scene import Scene

#: What has times before the simulations.
_ALONG_TIME = ("measured", "measured_rate")


def repeated(scene: Scene, number: int) -> Scene:
    """The surroundings of B sequences so many times: simulation b of run r is r B + b."""
    return Scene(**_several(scene, number))


class AtSamples(Scene):
    """The surroundings at all sampling times, each a simulation; simulation b of time k is
    k B + b, and its time stands in its state."""

    @classmethod
    def along(cls, scene: Scene) -> AtSamples:
        """Of B sequences of K samples."""
        own = _several(scene, len(scene.measured), skip=_ALONG_TIME)
        for name in _ALONG_TIME:
            own[name] = getattr(scene, name).flatten(0, 1)[None]
        return cls(**own)

    def _between(self, samples: Tensor, t: Tensor) -> Tensor:
        return samples[0]


def _several(scene: Scene, number: int, skip: tuple[str, ...] = ()) -> dict[str, Any]:
    found = {}
    for one in fields(Scene):
        value = getattr(scene, one.name)
        if isinstance(value, Tensor) and one.name not in skip:
            value = torch.cat([value] * number, 1 if one.name in _ALONG_TIME else 0)
        elif isinstance(value, tuple):
            value = value * number
        found[one.name] = value
    return found
