"""Engine of crowds: residuals on short windows of every person's path."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as Many
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.calibrate.parameters import ParameterVector, with_parameters
from nnode.data.sequence import Sequence, collate
from nnode.diagnosis.crowds.variables import crowd_variables
from nnode.diagnosis.crowds.whitening import Whitening
from nnode.diagnosis.crowds.windows import Windows
from nnode.diagnosis.eligibility import check_model
from nnode.diagnosis.outcome import Simulation
from nnode.diagnosis.residuals.engine import Squares, of_residuals, removes_enough
from nnode.diagnosis.residuals.variables import Variable
from nnode.model.effects.base import Effect, IndividualEffect, Probe
from nnode.model.system import Crowd, System
from nnode.model.term import State
from nnode.simulation.alone import PersonAlone, RunAlone, Surroundings

#: Largest difference between simulated and measured positions, m. Differences are clipped because
#: contact forces may throw a person far away.
LIMIT = 3.0
#: Number of pairs of people in the largest intermediate result.
CHUNK = 100_000


class CrowdEngine:
    """Residuals on windows in which every person is simulated alone among the others.

    In a crowd, errors of one person's simulated path would propagate to all. Therefore the
    sequences are cut into windows, the others follow their measured and smoothed paths, and the
    part of the differences that an unknown start state explains is projected out. The remaining
    differences of positions are whitened, and outlying windows have smaller weights.

    Args:
        sequences: of people, equally sampled.
        window: length of a window, s.
        clusters: ``(S,)`` of the sequences; None: each is one.

    Attributes:
        batch: the sequences.
        sequence: ``(n,)`` position of each residual's sequence in the batch.
        clock: ``(n,)`` start time of its window, s.
        unit: ``(n,)`` number of its person, counted through all sequences.
        people: of each unit the sequence and the place of the person.

    Raises:
        DataError: sequences too short for a window, or positions that are no numbers.
    """

    def __init__(
        self,
        sequences: Many[Sequence],
        window: float = 1.5,
        clusters: np.ndarray | None = None,
    ) -> None:
        self.sequences = list(sequences)
        self.batch = collate(sequences)
        self.windows = Windows(sequences, window)
        window_of, place_of = self.windows.person.T
        self._clusters = clusters
        pairs, unit = np.unique(
            np.stack([self.windows.sequence[window_of], place_of], 1), axis=0, return_inverse=True
        )
        self._unit = unit.reshape(-1)
        self.people = [[(int(b), int(i))] for b, i in pairs]
        self.names = [item.name for item in sequences]
        self._label(1)
        self._around: Surroundings | None = None
        self._whitening: Whitening | None = None
        self._run: tuple[System, Tensor, RunAlone] | None = None

    # -- the interface of engines ----------------------------------------------------------

    def residuals(self, system: System, rows: Tensor) -> Tensor:
        """``(R, n)``: whitened differences, measured minus simulated, of R runs of one model."""
        differences = self._differences(system, rows)
        self._fitted_whitening(system, rows[0])
        flat = differences.reshape(len(rows), *self._matrix.shape[::2], 1)
        return (self._matrix @ flat).reshape(len(rows), -1)

    def squares(self, system: System, row: Tensor) -> Squares:
        """Squared errors of positions, after start states were projected out."""
        window = self.windows.person[:, 0]
        squares = (self._projected_errors(system, row) ** 2).sum(-1)
        n_samples = squares.shape[1]
        return Squares(squares.ravel(), self.windows.sequence[window].repeat(n_samples))

    def relevant(self, before: System, after: System, square: float) -> bool:
        return removes_enough(self, before, after, square)

    def simulated(self, system: System, row: Tensor) -> list[Simulation | None]:
        """The windows in sequence, each from the best-fitting start state."""
        difference, length = self._projected_errors(system, row), self.windows.length
        simulations: list[Simulation | None] = [None] * len(self.sequences)
        for i in self.windows.used:
            s, first, stride = self.sequences[i], *self.windows.compared[i]
            windows = np.flatnonzero(self.windows.sequence == i)
            keep = first + stride * np.arange(length * len(windows))
            goal = s.x[-1] if s.destination is None else s.destination
            part = replace(
                s,
                time=s.time[keep],
                x=s.x[keep],
                v=None if s.v is None else s.v[keep],
                destination=goal,
            )
            x = part.x.copy()
            for number, window in enumerate(windows):
                people = self.windows.person[:, 0] == window
                who = self.windows.person[people, 1]
                x[number * length : (number + 1) * length, who] -= difference[people].swapaxes(0, 1)
            simulations[i] = Simulation(part, x, restart=length)
        return simulations

    def _projected_errors(self, system: System, row: Tensor) -> np.ndarray:
        """``(P, L, 2)`` m: measured minus simulated positions, start states projected out."""
        whitening = self._fitted_whitening(system, row)
        projected: np.ndarray = whitening.projected(self._differences(system, row[None]).numpy())[0]
        return projected.reshape(len(projected), -1, 2)

    def variables(self) -> list[Variable]:
        """The variables on which deviations of people may depend."""
        windows, no_forces = self.windows, Crowd([])
        measured = torch.cat([windows.batch.x[::2], windows.batch.v[::2]], -1)
        run = RunAlone(windows.around(no_forces), no_forces, measured)
        start_of = dict(zip(self.batch.names, self.batch.start.tolist(), strict=True))
        return crowd_variables(run.state, start_of)

    def noise_floor(self) -> float:
        """Mean square error of positions due to measurement noise, summed over both coordinates,
        m²."""
        length = self.windows.length
        return 2 * self.windows.variance * (1 - 2 / length)

    def fit_whitening(self, system: System, row: Tensor) -> None:
        """Fit the whitening and the weights to the residuals of a model, and linearise around it.

        It is called after a fit was accepted. Residuals before and after the call cannot be
        compared; even their number may change.
        """
        self._run = self._simulated(system, row)
        start, forced = self._run[-1].unit_responses()
        stride = self.windows.sub
        difference = self._differences(system, row[None])[0].numpy()
        self._whitening = Whitening.fit(
            difference, start[:, ::stride].numpy(), self._turns(), self.windows.variance
        )
        self._matrix = torch.as_tensor(self._whitening.matrix())
        self._response = self._matrix @ forced[:, ::stride].flatten(1, 2)
        self._label(self._matrix.shape[1])

    def _label(self, n_residuals: int) -> None:
        """Label the ``n_residuals`` residuals of every person's window."""
        window = self.windows.person[:, 0]
        self.sequence = self.windows.sequence[window].repeat(n_residuals)
        self.cluster = of_residuals(self._clusters, self.sequence)
        self.clock = self.windows.batch.start.numpy()[window].repeat(n_residuals)
        self.component = np.tile(np.arange(n_residuals), len(window))
        self.unit = self._unit.repeat(n_residuals)

    # -- linear response ----------------------------------------------------------------------

    def linearised(self, system: System, row: Tensor) -> RunAlone:
        """A model along its own paths; the response is that of the model of the whitening."""
        self._fitted_whitening(system, row)
        if self._run is None or self._run[0] is not system or not torch.equal(self._run[1], row):
            self._run = self._simulated(system, row)
        return self._run[-1]

    def _simulated(self, system: System, row: Tensor) -> tuple[System, Tensor, RunAlone]:
        states = self._states(system, row[None])[:, 0]
        filled = with_parameters(system, row)
        assert self._around is not None
        run = RunAlone(self._around, filled, states)
        return system, row.clone(), run

    def tangents(self, system: System, row: Tensor) -> Tensor:
        """``(K, n)``: derivatives of the residuals with respect to the calibrated parameters, by
        linear response."""
        run = self.linearised(system, row)
        rates = run.parameters(_differences(system))
        return torch.stack([self._respond(rate, run) for rate in rates])

    def response(
        self, system: System, row: Tensor, rates: Callable[[State], list[Tensor]]
    ) -> Tensor:
        """``(M, n)``: changes of the residuals by M weak additional accelerations, each a function
        of the states, ``(B, N, 2)`` m/s²."""
        run = self.linearised(system, row)
        with torch.no_grad():
            return torch.stack([self._respond(rate, run) for rate in rates(run.state)])

    def screen_columns(
        self, system: System, row: Tensor, effect: type[Effect], *probes: Probe
    ) -> Tensor:
        """``(S, n)``: derivatives of the residuals with respect to the strengths of one probe after
        the other, in the order of ``steps``; the change by the effect as a whole where it has no
        strength."""

        def rates(state: State) -> list[Tensor]:
            changes = []
            for probe in probes:
                base = effect(**probe.options)(state)
                for name, step in probe.steps.items():
                    changed = effect(**probe.options)
                    getattr(changed, name).add_(step)
                    changes.append((changed(state) - base) / step)
                if not probe.steps:
                    changes.append(base)
            return changes

        return self.response(system, row, rates)

    def individual(
        self, system: System, row: Tensor, effect: type[IndividualEffect], options: dict[str, Any]
    ) -> Tensor:
        """``(M, n)``: derivatives of every person's residuals by M agent-specific parameters,
        see :meth:`~nnode.model.effects.IndividualEffect.directions`.

        As people walk alone, the derivative with respect to one person's amount is the same
        column, restricted to the residuals of this unit.
        """
        names, n_agents = set(self.batch.names), self.windows.batch.x.shape[2]

        def rates(state: State) -> list[Tensor]:
            return [
                effect(people={name: [number] * n_agents for name in names}, **values)(state)
                for values, number in effect.directions(options)
            ]

        return self.response(system, row, rates)

    # -- parts -----------------------------------------------------------------------------

    def _fitted_whitening(self, system: System, row: Tensor) -> Whitening:
        if self._whitening is None:
            self.fit_whitening(system, row)
        assert self._whitening is not None
        return self._whitening

    def _respond(self, rate: Tensor, run: RunAlone) -> Tensor:
        """``(n,)``: change of the residuals by accelerations of the people."""
        return -(self._response @ run.of_people(rate)[..., None]).reshape(-1)

    def _differences(self, system: System, rows: Tensor) -> Tensor:
        """``(R, P, L, 2)`` m: measured minus simulated positions."""
        window_of, place_of = self.windows.person.T
        x = self._states(system, rows)[:: self.windows.sub, :, window_of, place_of, :2]
        measured = torch.from_numpy(self.windows.measured[:, window_of, place_of])
        difference = (measured[:, None] - x).permute(1, 2, 0, 3)
        return difference.nan_to_num(LIMIT, LIMIT, -LIMIT).clamp(-LIMIT, LIMIT)

    def _states(self, system: System, rows: Tensor) -> Tensor:
        """``(F, R, W, N, 4)`` simulated positions (m) and velocities (m/s) at the steps."""
        windows = self.windows
        # all systems of one diagnosis share walls, radii and masses
        if self._around is None:
            check_model(system)
            self._around = windows.around(system)
        w, n = windows.batch.agent.shape
        first = torch.cat([windows.batch.x[0], windows.batch.v[0]], -1)
        states = []
        for part in rows.split(max(1, CHUNK // (w * n * n))):
            rhs = PersonAlone(self._around, system, ParameterVector(system).runs(part))
            states.append(rhs.simulated(first, windows.steps))
        return torch.cat(states, 1)

    def _turns(self) -> np.ndarray:
        """``(P, 2, 2)``: unit vectors along and across each person's path in the window."""
        window, person = self.windows.person.T
        x = self.windows.batch.x[:, window, person].numpy()
        goal = self.windows.batch.destination[window, person].numpy()
        displacement, to_goal = x[-1] - x[0], goal - x[0]
        standing = np.hypot(*displacement.T) < 0.1
        displacement = np.where(standing[:, None], to_goal, displacement)
        displacement = displacement / np.maximum(np.hypot(*displacement.T), 1e-9)[:, None]
        return np.stack([displacement, np.stack([-displacement[:, 1], displacement[:, 0]], 1)], 1)


def _differences(system: System) -> list[float]:
    """``(K,)``: finite differences of the parameters."""
    differences = []
    for name, p in ParameterVector(system).parameters.items():
        _, place, key = name.split(".", 2)
        term = system.terms[int(place)]
        strength = term.strengths.get(key) if isinstance(term, Effect) else None
        size = 1e-3 * max(1.0, float(p.detach().abs().max()))
        differences += [size if strength is None else abs(strength.step)] * p.numel()
    return differences
