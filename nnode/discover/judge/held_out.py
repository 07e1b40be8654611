"""Agents' own numbers, held out: from the first part of their time, tried on the later part.

Variance, shrinkage and settings come from the open clusters, an agent's number from the first part
of the time in which he and those around him are seen in the sealed sequences; the score is that of
the last part, simulated from the state in which it begins. What predicts as well from the same
first part stands beside it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Sequence
from nnode.discover.found import Simulation
from nnode.discover.judge.confirm import Comparing, windows_of
from nnode.discover.statistics.random_effects import Individuals, numbers, with_people
from nnode.errors import DataError, SimulationError
from nnode.model.system import Crowd, System

#: Shares of the time: the first part, and from where on the last part begins. What lies between
#: keeps moods from carrying over.
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
        leaning: ``(G,)`` of the others of :data:`MODELS` towards own numbers, by cluster, see
            :meth:`Comparing.leaning`.
        floor: of the measurement, m².
        simulated: whose errors the costs of ``base`` and of own numbers are.
    """

    used: list[int]
    costs: dict[str, np.ndarray]
    leaning: dict[str, np.ndarray]
    floor: float
    simulated: tuple[list[Simulation | None], list[Simulation | None]]


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
    early, last, used = _parts(sequences)
    if not used or not early:
        return None
    try:
        engine = windows_of(system, early)
        engine.settle(system, ParameterVector(system).row)
        people, shared = (
            _carried(early, last, numbers(engine, system, one, common=common))
            for common in (False, True)
        )
        comparing = Comparing(windows_of(system, last, label[used]), system)
        each = {
            MODELS[0]: system,
            MODELS[1]: with_people(system, one, people),
            MODELS[2]: with_people(system, one, shared),
        }
        found = {name: comparing.squares(model) for name, model in each.items()}
        leaning = {
            name: comparing.leaning(model, each[MODELS[1]])
            for name, model in each.items()
            if name != MODELS[1]
        }
        found["base"] = comparing.squares(base)
        simulated = comparing.simulated(base), comparing.simulated(each[MODELS[1]])
    except (DataError, SimulationError):
        return None
    if domain == "crowd":
        # an engine of people takes out what start states explain: to go straight on is no force
        found["constant velocity"] = comparing.squares(Crowd([]))
    else:
        found |= _straight(early, last)
    return Later(used, found, leaning, comparing.floor, simulated)


def _parts(sequences: list[Sequence]) -> tuple[list[Sequence], list[Sequence], list[int]]:
    """Pieces of sequences in the first and in the last part of their agents' time, and the
    positions of those that have a last one."""
    seen: dict[Agent, tuple[float, float]] = {}
    for s in sequences:
        for agent in _agents(s):
            first, end = seen.get(agent, (np.inf, -np.inf))
            seen[agent] = min(first, float(s.time[0])), max(end, float(s.time[-1]))
    early, last, used = [], [], []
    for i, s in enumerate(sequences):
        times = [seen[agent] for agent in _agents(s)]
        start, end = min(first for first, _ in times), max(end for _, end in times)
        length = end - start
        before = _piece(s, start, start + FIRST * length)
        after = _piece(s, start + LAST * length, end)
        early += [] if before is None else [before]
        if after is not None:
            last.append(after)
            used.append(i)
    return early, last, used


#: Site, sequence where there are no identifiers, and who.
Agent = tuple[str, str, str]


def _agents(s: Sequence) -> list[Agent]:
    if s.agents:
        return [(s.site or s.recording, "", agent) for agent in s.agents]
    return [(s.recording, s.name, str(n)) for n in range(s.n_agents)]


def _piece(sequence: Sequence, start: float, end: float) -> Sequence | None:
    """What of a sequence lies between two times; None where it is too short."""
    part = (sequence.time >= start - 1e-6) & (sequence.time <= end + 1e-6)
    if part.sum() < LEAST:
        return None
    goal = sequence.x[-1] if sequence.destination is None else sequence.destination
    return replace(
        sequence,
        time=sequence.time[part],
        x=sequence.x[part],
        v=None if sequence.v is None else sequence.v[part],
        destination=goal if sequence.x.shape[2] == 2 else sequence.destination,
    )


def _carried(
    early: list[Sequence], last: list[Sequence], people: dict[str, list[float]]
) -> dict[str, list[float]]:
    """The numbers of the agents of the last parts: the mean of those of their first parts."""
    known: dict[Agent, list[float]] = {}
    for s in early:
        for agent, number in zip(_agents(s), people[s.name], strict=False):
            known.setdefault(agent, []).append(number)
    return {s.name: [float(np.mean(known.get(agent, [0.0]))) for agent in _agents(s)] for s in last}


def _straight(early: list[Sequence], last: list[Sequence]) -> dict[str, np.ndarray]:
    """Errors of followers who keep the mean, or the last, velocity of the first part; who has none
    keeps the mean of all."""
    mean: dict[Agent, list[float]] = {}
    final: dict[Agent, tuple[float, float]] = {}
    for s in early:
        known = max(2, min(s.n_samples, int(1.0 / s.dt) + 1))
        for n, agent in enumerate(_agents(s)):
            x = s.x[:, n, 0]
            mean.setdefault(agent, []).append((x[-1] - x[0]) / (s.dt * (len(x) - 1)))
            speed = (x[-1] - x[-known]) / (s.dt * (known - 1))
            final[agent] = max(final.get(agent, (-np.inf, 0.0)), (float(s.time[-1]), speed))
    usual = float(np.mean([np.mean(own) for own in mean.values()]))
    speeds = {
        "own mean velocity": {agent: float(np.mean(own)) for agent, own in mean.items()},
        "constant velocity": {agent: speed for agent, (_, speed) in final.items()},
    }
    found = {}
    for name, known_speeds in speeds.items():
        costs = []
        for s in last:
            speed = np.array([known_speeds.get(agent, usual) for agent in _agents(s)[:-1]])
            away = s.x[:, :-1, 0] - s.x[0, :-1, 0] - speed * (s.time - s.time[0])[:, None]
            costs.append(float((away[1:] ** 2).mean()))
        found[name] = np.array(costs)
    return found
