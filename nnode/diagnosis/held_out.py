"""Held-out test of agent-specific parameters: estimated early, tested on the later part.

Variance, shrinkage and settings are estimated in the exploration clusters. In the confirmation
sequences, an agent's parameter is estimated from the first part of the time in which the agent and
its neighbours are observed. Errors are those of the last part, simulated from its first state. They
are compared with the errors of simpler predictions from the same first part.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Sequence
from nnode.diagnosis.model_comparison import ModelComparison, windows_of
from nnode.diagnosis.outcome import Simulation
from nnode.diagnosis.statistics.random_effects import (
    IndividualEstimate,
    agent_parameters,
    with_agent_parameters,
)
from nnode.errors import DataError, SimulationError
from nnode.model.system import Crowd, System

#: Shares of the time: the end of the first part and the begin of the last part. The gap between
#: them lets transient deviations decay.
FIRST, LAST = 0.4, 0.6
#: Samples that each part needs.
LEAST = 4

#: Names of the compared models.
MODELS = ("without numbers", "own numbers", "one number per sequence")


@dataclass
class HeldOutErrors:
    """Errors in the last part of each sequence.

    Attributes:
        used: positions of the sequences that are long enough.
        costs: ``(U,)`` mean square errors, m², of :data:`MODELS`, of ``base`` (the model as it was
            given), ``own mean velocity`` and ``constant velocity``.
        score_toward: ``(G,)`` scores of the other :data:`MODELS` toward the one with agent-specific
            parameters, by cluster, see :meth:`ModelComparison.score_toward`.
        floor: the variance of the measurement noise, m².
        simulated: the simulations of ``base`` and of agent-specific parameters.
    """

    used: list[int]
    costs: dict[str, np.ndarray]
    score_toward: dict[str, np.ndarray]
    floor: float
    simulated: tuple[list[Simulation | None], list[Simulation | None]]


def held_out_errors(
    domain: str,
    base: System,
    system: System,
    estimate: IndividualEstimate,
    sequences: list[Sequence],
    label: np.ndarray,
) -> HeldOutErrors | None:
    """The errors in the last part; None if no sequence is long enough.

    Args:
        base: the model as it was given. system: with the population's effects.
        estimate: of an individual effect in the exploration clusters.
        sequences: of the confirmation set. label: ``(S,)`` their clusters.
    """
    early_pieces, late_pieces, used = _parts(sequences)
    if not used or not early_pieces:
        return None
    try:
        engine = windows_of(system, early_pieces)
        engine.fit_whitening(system, ParameterVector(system).row)
        people, shared = (
            _carried(
                early_pieces, late_pieces, agent_parameters(engine, system, estimate, common=common)
            )
            for common in (False, True)
        )
        comparison = ModelComparison(windows_of(system, late_pieces, label[used]), system)
        models = {
            MODELS[0]: system,
            MODELS[1]: with_agent_parameters(system, estimate, people),
            MODELS[2]: with_agent_parameters(system, estimate, shared),
        }
        costs = {name: comparison.squares(model) for name, model in models.items()}
        score_toward = {
            name: comparison.score_toward(model, models[MODELS[1]])
            for name, model in models.items()
            if name != MODELS[1]
        }
        costs["base"] = comparison.squares(base)
        simulated = comparison.simulated(base), comparison.simulated(models[MODELS[1]])
    except (DataError, SimulationError):
        return None
    if domain == "crowd":
        # a crowd without forces moves at constant velocity, and start states are projected out
        costs["constant velocity"] = comparison.squares(Crowd([]))
    else:
        costs |= _constant_velocity_errors(early_pieces, late_pieces)
    return HeldOutErrors(used, costs, score_toward, comparison.floor, simulated)


def _parts(sequences: list[Sequence]) -> tuple[list[Sequence], list[Sequence], list[int]]:
    """Pieces of sequences in the first and in the last part of their agents' time, and the
    positions of the sequences that have a last piece."""
    spans: dict[Agent, tuple[float, float]] = {}
    for s in sequences:
        for agent in _agents(s):
            begin, finish = spans.get(agent, (np.inf, -np.inf))
            spans[agent] = min(begin, float(s.time[0])), max(finish, float(s.time[-1]))
    early, late, used = [], [], []
    for i, s in enumerate(sequences):
        times = [spans[agent] for agent in _agents(s)]
        start, finish = min(begin for begin, _ in times), max(finish for _, finish in times)
        length = finish - start
        early_piece = _piece(s, start, start + FIRST * length)
        late_piece = _piece(s, start + LAST * length, finish)
        early += [] if early_piece is None else [early_piece]
        if late_piece is not None:
            late.append(late_piece)
            used.append(i)
    return early, late, used


#: Site, sequence (empty if agents have identifiers), and agent.
Agent = tuple[str, str, str]


def _agents(s: Sequence) -> list[Agent]:
    if s.agents:
        return [(s.site or s.recording, "", agent) for agent in s.agents]
    return [(s.recording, s.name, str(n)) for n in range(s.n_agents)]


def _piece(sequence: Sequence, start: float, end: float) -> Sequence | None:
    """The part of a sequence between two times; None if it is too short."""
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
    early: list[Sequence], late: list[Sequence], people: dict[str, list[float]]
) -> dict[str, list[float]]:
    """The agents' parameters in the last parts: the mean of their estimates in the first parts."""
    early_numbers: dict[Agent, list[float]] = {}
    for s in early:
        for agent, number in zip(_agents(s), people[s.name], strict=False):
            early_numbers.setdefault(agent, []).append(number)
    return {
        s.name: [float(np.mean(early_numbers.get(agent, [0.0]))) for agent in _agents(s)]
        for s in late
    }


def _constant_velocity_errors(early: list[Sequence], late: list[Sequence]) -> dict[str, np.ndarray]:
    """Errors of followers who keep the mean, or the last, velocity of their first part. Followers
    without a first part keep the mean velocity of all."""
    mean: dict[Agent, list[float]] = {}
    final: dict[Agent, tuple[float, float]] = {}
    for s in early:
        n_last = max(2, min(s.n_samples, int(1.0 / s.dt) + 1))
        for n, agent in enumerate(_agents(s)):
            x = s.x[:, n, 0]
            mean.setdefault(agent, []).append((x[-1] - x[0]) / (s.dt * (len(x) - 1)))
            speed = (x[-1] - x[-n_last]) / (s.dt * (n_last - 1))
            final[agent] = max(final.get(agent, (-np.inf, 0.0)), (float(s.time[-1]), speed))
    overall_mean = float(np.mean([np.mean(agent_speeds) for agent_speeds in mean.values()]))
    speeds = {
        "own mean velocity": {
            agent: float(np.mean(agent_speeds)) for agent, agent_speeds in mean.items()
        },
        "constant velocity": {agent: speed for agent, (_, speed) in final.items()},
    }
    errors = {}
    for name, speed_of in speeds.items():
        costs = []
        for s in late:
            speed = np.array([speed_of.get(agent, overall_mean) for agent in _agents(s)[:-1]])
            deviation = s.x[:, :-1, 0] - s.x[0, :-1, 0] - speed * (s.time - s.time[0])[:, None]
            costs.append(float((deviation[1:] ** 2).mean()))
        errors[name] = np.array(costs)
    return errors
