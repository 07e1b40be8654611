"""Agents' own numbers, held out: from the first part of their time, tried on the later part.

Variance, shrinkage and settings come from the open clusters, an agent's number from the first part
of a sealed sequence; the score is that of the last part, simulated from the state in which it
begins. What predicts as well from the same first part stands beside it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from nnode.data.sequence import Sequence
from nnode.discover.confirm import Comparing, engine_of
from nnode.discover.engine import row_of
from nnode.discover.individual import Individuals, numbers, with_people
from nnode.errors import DataError, SimulationError
from nnode.models.system import Crowd, System

#: Shares of a sequence's time: the first part, and from where on the last part begins. What lies
#: between keeps moods from carrying over.
FIRST, LAST = 0.4, 0.6
#: Samples that each part needs.
LEAST = 4

#: Who predicts: the models, and those that know no law.
MODELS = ("without numbers", "own numbers", "one number per sequence")


@dataclass
class Later:
    """Errors in the last part of each sequence.

    Attributes:
        used: positions of the sequences that are long enough.
        costs: ``(U,)`` mean square errors, m², by who predicts: :data:`MODELS` and
            ``base`` (the model as it was given), ``own mean velocity``, ``constant velocity``.
        scores: ``(G,)`` of the models by cluster, see :class:`~nnode.discover.confirm.Comparing`.
        floor: of the measurement, m².
    """

    used: list[int]
    costs: dict[str, np.ndarray]
    scores: dict[str, np.ndarray]
    floor: float


def later(
    domain: str,
    base: System,
    system: System,
    one: Individuals,
    sequences: list[Sequence],
    label: np.ndarray,
) -> Later | None:
    """None where no sequence is long enough.

    Args:
        base: the model as it was given. system: with the population's effects.
        one: an individual effect, of the open clusters.
        sequences: sealed. label: ``(S,)`` their clusters.
    """
    used = [i for i, s in enumerate(sequences) if FIRST * (s.n_samples - 1) >= LEAST - 1]
    if not used:
        return None
    early = [_part(sequences[i], 0.0, FIRST) for i in used]
    last = [_part(sequences[i], LAST, 1.0) for i in used]
    try:
        engine = engine_of(domain, early)
        engine.settle(system, row_of(system))
        people = numbers(engine, system, one)
        shared = numbers(engine, system, one, common=True)
        comparing = Comparing(domain, last, system, label[used])
        each = {
            MODELS[0]: system,
            MODELS[1]: with_people(system, one, people),
            MODELS[2]: with_people(system, one, shared),
        }
        found = {name: comparing.squares(model) for name, model in each.items()}
        scores = {name: comparing.scores(model) for name, model in each.items()}
        found["base"] = comparing.squares(base)
    except (DataError, SimulationError):
        return None
    if domain == "crowd":
        # an engine of people takes out what start states explain: to go straight on is no force
        found["constant velocity"] = comparing.squares(Crowd([]))
    else:
        found |= _straight(early, last)
    return Later(used, found, scores, comparing.floor)


def _part(sequence: Sequence, start: float, end: float) -> Sequence:
    number = sequence.n_samples - 1
    part = slice(int(np.ceil(start * number - 1e-9)), int(end * number + 1e-9) + 1)
    goal = sequence.x[-1] if sequence.destination is None else sequence.destination
    return replace(
        sequence,
        time=sequence.time[part],
        x=sequence.x[part],
        v=None if sequence.v is None else sequence.v[part],
        destination=goal if sequence.x.shape[2] == 2 else sequence.destination,
    )


def _straight(early: list[Sequence], last: list[Sequence]) -> dict[str, np.ndarray]:
    """Errors of followers who keep the mean, or the last, velocity of the first part."""
    mean: list[float] = []
    final: list[float] = []
    for first, rest in zip(early, last, strict=True):
        elapsed = (rest.time - rest.time[0])[:, None]
        x = rest.x[:, :-1, 0]
        own = first.x[:, :-1, 0]
        known = max(2, min(len(own), int(1.0 / first.dt) + 1))
        for found, part in ((mean, own), (final, own[-known:])):
            speed = (part[-1] - part[0]) / (first.dt * (len(part) - 1))
            away = (x - x[0] - speed * elapsed)[1:]
            found.append(float((away**2).mean()))
    return {"own mean velocity": np.array(mean), "constant velocity": np.array(final)}
