"""The problems that the benchmark poses, the same for every engine."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from nnode.data.sequence import Batch, Sequence, collate
from nnode.model import Crowd, System, Traffic, make_law
from nnode.model.build import add_effects
from nnode.model.laws import law_from


@dataclass(frozen=True)
class Shape:
    """The size of a problem.

    Attributes:
        domain: ``traffic`` or ``crowd``.
        models: the models that are timed on it.
        sequences, agents: how many simulations, of how many vehicles or people.
        samples: measured samples after the first one.
        per: Euler steps in a sampling interval.
        step: s.
    """

    domain: str
    models: tuple[str, ...]
    sequences: int
    agents: int
    samples: int
    per: int
    step: float

    @property
    def steps(self) -> int:
        """Euler steps of a simulation."""
        return self.samples * self.per


def _hall(people: int) -> Shape:
    return Shape("crowd", ("sf",), 1, people, 25, 1, 0.04)


_LAWS = ("lin", "log", "n4")
SHAPES: dict[str, tuple[Shape, ...]] = {
    # the recordings of the paper: sampled at 5 frames/s, 1.2 s
    "paper": (Shape("traffic", _LAWS, 34, 4, 6, 100, 0.002),),
    "stress": (Shape("traffic", ("n4", "idm"), 100, 10, 50, 100, 0.002),),
    "steps": tuple(
        Shape("traffic", ("n4",), 34, 4, samples, 100, 0.002) for samples in (1, 3, 10, 30, 100)
    ),
    # a law, the same with one and three effects, and a law of second order
    "effects": (Shape("traffic", ("lin", "lin+1", "lin+3", "idm"), 100, 10, 50, 100, 0.002),),
    # eight parameters each; of the last one speeds depend on those ahead
    "tangents": (Shape("traffic", ("lin_places", "idm_zone", "lin_ahead"), 100, 10, 50, 10, 0.02),),
    # 30 s; by methods of stepping, which have their own steps
    "methods": (Shape("traffic", ("n4", "idm"), 100, 10, 300, 50, 0.002),),
    "crowd": (Shape("crowd", ("sf", "nn"), 128, 44, 25, 1, 0.04),),
    "crowd_effects": (Shape("crowd", ("sf", "sf+1", "sf+3"), 16, 44, 25, 1, 0.04),),
    # one hall: few enough people for every engine, then as many as cell lists allow
    "people": tuple(_hall(people) for people in (50, 100, 200)),
    "scale": tuple(_hall(people) for people in (500, 1000, 2000, 5000, 10000)),
}


#: What is added to a law, in this order.
EFFECTS: dict[str, tuple[dict[str, Any], ...]] = {
    "traffic": (
        {"name": "relative_speed", "kappa": 0.3},
        {"name": "speed_zone", "alpha": 0.8, "a": 100.0, "b": 300.0},
        {"name": "multi_anticipation", "c": 0.1},
    ),
    "crowd": (
        {"name": "alignment", "c": 0.2},
        {"name": "anticipation", "T_a": 0.2},
        {"name": "preferred_speed", "c": 0.5, "v_pref": 1.3},
    ),
}
_ZONE = {"name": "speed_zone", "alpha": 0.8, "a": 100.0, "b": 300.0}
#: Laws with effects that make eight parameters; no step of time meets a period's corner.
EIGHT: dict[str, tuple[dict[str, Any], ...]] = {
    "lin_places": (_ZONE, {"name": "speed_period", "alpha": 1.1, "a": 2.013, "b": 6.007}),
    "idm_zone": (_ZONE,),
    "lin_ahead": (
        _ZONE,
        {"name": "multi_anticipation", "c": 0.1},
        {"name": "asymmetric_response", "kappa_open": 0.2, "kappa_close": 0.4},
    ),
}
#: The Intelligent Driver Model, gaps from front to front (Treiber, Hennecke & Helbing 2000).
IDM = {
    "parameters": {"v0": "30 m/s", "T": "1.2 s", "s0": "2 m", "a": "1.3 m/s²", "b": "1.7 m/s²"},
    "where": {"wish": "s0 + max(v*T + v*dv/(2*sqrt(a*b)), 0)"},
    "rate": {"v": "a*(1 - (v/v0)**4 - (wish/gap)**2)"},
}


@dataclass(frozen=True)
class Problem:
    """A model, its data, and how finely it is solved."""

    shape: Shape
    model: str
    system: System
    batch: Batch

    @property
    def label(self) -> str:
        """One line for a table."""
        shape = self.shape
        who = "cars" if shape.domain == "traffic" else "people"
        many = "sequence" if shape.sequences == 1 else "sequences"
        return (
            f"{self.model}: {shape.sequences} {many}, {shape.agents} {who}, "
            f"{shape.steps} steps of {shape.step:g} s"
        )


def _platoons(shape: Shape, draw: np.random.Generator) -> list[Sequence]:
    t = shape.per * shape.step * np.arange(shape.samples + 1)
    found = []
    for number in range(shape.sequences):
        x0 = np.cumsum(draw.uniform(10, 30, shape.agents))
        x = x0 + 15.0 * t[:, None]
        x[1:] += 0.2 * draw.standard_normal(x[1:].shape)
        name = f"platoon/{number}"
        found.append(Sequence(name=name, recording="made", time=t, x=x[:, :, None]))
    return found


def _people(shape: Shape, draw: np.random.Generator) -> list[Sequence]:
    t = shape.per * shape.step * np.arange(shape.samples + 1)
    # one per square metre: a corridor of 2 walls of 10 m, or a square without walls
    alone = shape.sequences == 1
    long = float(np.ceil(shape.agents**0.5)) if alone else 10.0
    wide = long if alone else shape.agents / long
    columns = int(np.ceil((shape.agents * long / wide) ** 0.5))
    place = np.arange(shape.agents)
    cell = np.stack([place % columns, place // columns], 1) + 0.5
    grid = cell * np.array([long / columns, wide / np.ceil(shape.agents / columns)])
    walls = np.array([[0.0, 0.0, long, 0.0], [long, wide, 0.0, wide]])
    found = []
    for number in range(shape.sequences):
        x0 = grid + draw.uniform(-0.2, 0.2, grid.shape)
        v = np.array([1.3, 0.0]) + 0.1 * draw.standard_normal(grid.shape)
        x = x0 + t[:, None, None] * v
        found.append(
            Sequence(
                name=f"crowd/{number}",
                recording="made",
                time=t,
                x=x,
                v=np.broadcast_to(v, x.shape),
                destination=x0 + np.array([20.0, 0.0]),
                walls=None if alone else walls,
            )
        )
    return found


def _system(model: str) -> System:
    name, _, number = model.partition("+")
    system = _law(name.partition("_")[0])
    add_effects(system, EIGHT.get(name, EFFECTS[system.domain][: int(number or 0)]))
    return system


def _law(model: str) -> System:
    generator = torch.Generator().manual_seed(1)
    if model == "sf":
        return Crowd(
            [make_law("relaxation"), make_law("social_force", A=5.0, k=30.0, kappa=10.0, B=0.1)]
        )
    if model == "nn":
        return Crowd([make_law("relaxation"), make_law("network_force", generator=generator)])
    if model.startswith("n"):
        found = make_law("network_speed", hidden=int(model[1:]), v0=18.0, generator=generator)
    elif model == "idm":
        found = law_from("idm", IDM)
    else:
        found = make_law(model, v0=18.0, L=4.0)
    return Traffic([found], leader="constant")


def pose(shape: Shape, model: str, dtype: torch.dtype) -> Problem:
    """The problem of one shape and model, the same numbers at every call and precision."""
    draw = np.random.default_rng(shape.sequences + shape.agents)
    items = (_platoons if shape.domain == "traffic" else _people)(shape, draw)
    # rounded first, so that float32 and float64 pose the same problem
    batch = collate(items).to(dtype=torch.float32).to(dtype=dtype)
    system = _system(model).to(torch.float32).to(dtype)
    return Problem(shape, model, system, batch)
