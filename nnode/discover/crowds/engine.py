"""The residuals of models of crowds, on short windows of every person's path."""

from __future__ import annotations

import copy
from collections.abc import Callable
from collections.abc import Sequence as Many
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Sequence, collate
from nnode.discover.able import check_model
from nnode.discover.crowds.response import Frames, propagate
from nnode.discover.crowds.variables import crowd_variables
from nnode.discover.crowds.walk import Tables, Walk
from nnode.discover.crowds.whitening import Whitening
from nnode.discover.crowds.windows import Windows, WindowScene
from nnode.discover.found import Simulation
from nnode.discover.residuals.engine import Squares, of_residuals
from nnode.discover.residuals.variables import Variable
from nnode.model.effects.base import Effect, IndividualEffect, Probe
from nnode.model.system import Crowd, System
from nnode.model.term import State

#: A simulated person is never further than this from the measured one, m: contacts may throw
#: somebody far away, and the rest of the run still counts.
LIMIT = 3.0


@dataclass
class Linearised:
    """A model at one row of parameters.

    Attributes:
        system: the model.
        row: ``(K,)`` its parameters.
        frames: the moments along its paths.
    """

    system: System
    row: Tensor
    frames: Frames


class CrowdEngine:
    """Residuals on windows in which everyone is simulated alone among the others.

    In a crowd, errors of one person's simulated path would spread to all. So the sequences are
    cut into windows, the others walk on their measured and smoothed paths, and what an unknown
    start state of a person explains is projected out. The remaining differences of positions are
    whitened, and windows in which a person does something quite unusual count less.

    Args:
        sequences: of people, equally sampled.
        window: length of a window, s.
        clusters: ``(S,)`` of the sequences; None: each is one.

    Attributes:
        batch: the sequences.
        sequence: ``(n,)`` position of each residual's sequence in the batch.
        clock: ``(n,)`` s, when its window begins.
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
        which, who = self.windows.person.T
        self._clusters = clusters
        pairs, unit = np.unique(
            np.stack([self.windows.sequence[which], who], 1), axis=0, return_inverse=True
        )
        self._unit = unit.reshape(-1)
        self.people = [[(int(b), int(i))] for b, i in pairs]
        self.names = [item.name for item in sequences]
        self._label(1)
        self._scene: WindowScene | None = None
        self._tables: Tables | None = None
        self._whitening: Whitening | None = None
        self._now: Linearised | None = None

    # -- what every engine has -------------------------------------------------------------

    def residuals(self, system: System, rows: Tensor) -> Tensor:
        """``(R, n)``: whitened differences, measured minus simulated, of R runs of one model."""
        differences = self._differences(system, rows)
        self._settled(system, rows[0])
        flat = differences.reshape(len(rows), *self._matrix.shape[::2], 1)
        return (self._matrix @ flat).reshape(len(rows), -1)

    def squares(self, system: System, row: Tensor) -> Squares:
        """Squared errors of positions, without what start states explain."""
        which = self.windows.person[:, 0]
        squares = (self._away(system, row) ** 2).sum(-1)
        each = squares.shape[1]
        return Squares(squares.ravel(), self.windows.sequence[which].repeat(each))

    def simulated(self, system: System, row: Tensor) -> list[Simulation | None]:
        """Windows one after the other, each from the start state that suits the model best."""
        away, length = self._away(system, row), self.windows.length
        found: list[Simulation | None] = [None] * len(self.sequences)
        for i in self.windows.used:
            s, first, stride = self.sequences[i], *self.windows.compared[i]
            windows = np.flatnonzero(self.windows.sequence == i)
            keep = first + stride * np.arange(length * len(windows))
            goal = s.x[-1] if s.destination is None else s.destination
            part = replace(
                s, time=s.time[keep], x=s.x[keep], v=None if s.v is None else s.v[keep],
                destination=goal,
            )  # fmt: skip
            x = part.x.copy()
            for number, window in enumerate(windows):
                people = self.windows.person[:, 0] == window
                who = self.windows.person[people, 1]
                x[number * length : (number + 1) * length, who] -= away[people].swapaxes(0, 1)
            found[i] = Simulation(part, x, restart=length)
        return found

    def _away(self, system: System, row: Tensor) -> np.ndarray:
        """``(P, L, 2)`` m: measured minus simulated positions, without what starts explain."""
        whitening = self._settled(system, row)
        found: np.ndarray = whitening.projected(self._differences(system, row[None]).numpy())[0]
        return found.reshape(len(found), -1, 2)

    def variables(self) -> list[Variable]:
        """What deviations of people may depend on."""
        scene = self.windows.scene(Crowd([]))
        frames = scene.frames(2, self.windows.step * torch.arange(self.windows.steps + 1).double())
        assert frames.speed is not None
        zero = torch.zeros((), dtype=frames.speed.dtype)
        state = State(zero, frames.measured[0], frames.speed[0], frames)
        first = dict(zip(self.batch.names, self.batch.start.tolist(), strict=True))
        return crowd_variables(state, first)

    def noise_floor(self) -> float:
        """m²: mean square of :meth:`positions` that the measurement's noise alone makes, summed
        over both coordinates."""
        length = self.windows.length
        return 2 * self.windows.variance * (1 - 2 / length)

    def settle(self, system: System, row: Tensor) -> None:
        """Take a model as the one around which residuals are whitened, weighted and linearised.

        Called after a fit was accepted; residuals from before cannot be compared with later ones,
        and even their number may change.
        """
        walk = self._walk(system)
        x, v = walk.paths(row[None])
        start, forced = propagate(Frames(walk, row, x[:, 0], v[:, 0]).jacobian(), walk.windows.step)
        every = self.windows.sub
        difference = self._difference(x)[0].numpy()
        turn = self._turns()
        self._whitening = Whitening.fit(
            difference, start[:, ::every].numpy(), turn, self.windows.variance
        )
        matrix = torch.as_tensor(self._whitening.matrix())
        sampled = forced[:, ::every]
        p, length = sampled.shape[:2]
        self._response = matrix @ sampled.reshape(p, length * 2, -1)
        self._matrix = matrix
        self._label(matrix.shape[1])
        self._now = None

    def _label(self, each: int) -> None:
        """Say whose ``each`` residuals of every person's window are."""
        which = self.windows.person[:, 0]
        self.sequence = self.windows.sequence[which].repeat(each)
        self.cluster = of_residuals(self._clusters, self.sequence)
        self.clock = self.windows.batch.start.numpy()[which].repeat(each)
        self.component = np.tile(np.arange(each), len(which))
        self.unit = self._unit.repeat(each)

    # -- what makes it fast ----------------------------------------------------------------

    def linearised(self, system: System, row: Tensor) -> Linearised:
        """A model along its own paths; the response is that of the model it was settled at."""
        self._settled(system, row)
        now = self._now
        if now is not None and now.system is system and torch.equal(now.row, row):
            return now
        walk = self._walk(copy.deepcopy(system))
        ParameterVector(walk.system).fill_(row)
        x, v = walk.paths(row[None])
        self._now = Linearised(system, row.clone(), Frames(walk, row, x[:, 0], v[:, 0]))
        return self._now

    def tangents(self, system: System, row: Tensor) -> Tensor:
        """``(K, n)``: derivatives of the residuals with respect to the calibrated parameters.

        By linear response; a simulation for each parameter gives nearly the same.
        """
        frames = self.linearised(system, row).frames
        return torch.stack([self._respond(rate, frames) for rate in frames.parameter_tangents()])

    def response(
        self, system: System, row: Tensor, rates: Callable[[State], list[Tensor]]
    ) -> Tensor:
        """``(M, n)``: changes of the residuals by M weak additional accelerations, each a function
        of the states, ``(B, N, 2)`` m/s²."""
        frames = self.linearised(system, row).frames
        with torch.no_grad():
            return torch.stack([self._respond(rate, frames) for rate in rates(frames.state())])

    def screen_columns(
        self, system: System, row: Tensor, effect: type[Effect], probe: Probe
    ) -> Tensor:
        """``(S, n)``: derivatives of the residuals with respect to the strengths of a probe, in
        the order of its ``steps``; the change by the effect as a whole where it has no strength."""

        def rates(state: State) -> list[Tensor]:
            without, found = effect(**probe.options)(state), []
            if not probe.steps:
                return [without]
            for name, step in probe.steps.items():
                changed = effect(**probe.options)
                getattr(changed, name).add_(step)
                found.append((changed(state) - without) / step)
            return found

        return self.response(system, row, rates)

    def individual(
        self, system: System, row: Tensor, effect: type[IndividualEffect], options: dict[str, Any]
    ) -> Tensor:
        """``(M, n)``: derivatives of everyone's residuals with respect to M amounts of his own,
        see :meth:`~nnode.model.effects.IndividualEffect.directions`.

        As people walk alone, the derivative with respect to one person's amount is the same
        column, restricted to the residuals of this unit.
        """
        frames = self.linearised(system, row).frames
        state = frames.state()
        names = set(frames.scene.names)
        most = state.x.shape[1]

        def column(values: dict[str, Any], number: float) -> Tensor:
            people = {name: [number] * most for name in names}
            return self._respond(effect(people=people, **values)(state), frames)

        with torch.no_grad():
            return torch.stack([column(*one) for one in effect.directions(options)])

    # -- parts -----------------------------------------------------------------------------

    def _settled(self, system: System, row: Tensor) -> Whitening:
        if self._whitening is None:
            self.settle(system, row)
        assert self._whitening is not None
        return self._whitening

    def _respond(self, rate: Tensor, frames: Frames) -> Tensor:
        """``(n,)``: change of the residuals by accelerations ``(W * F, N, 2)``."""
        field = frames.of_people(rate)
        moved = self._response @ field.reshape(len(field), -1, 1)
        return -moved.reshape(-1)

    def _differences(self, system: System, rows: Tensor) -> Tensor:
        return self._difference(self._walk(system).paths(rows)[0])

    def _difference(self, x: Tensor) -> Tensor:
        """``(R, P, L, 2)`` m: measured minus simulated positions ``(F, R, P, 2)``."""
        which, who = self.windows.person.T
        measured = torch.from_numpy(self.windows.measured[:, which, who])
        difference = (measured[:, None] - x[:: self.windows.sub]).permute(1, 2, 0, 3)
        return difference.nan_to_num(LIMIT, LIMIT, -LIMIT).clamp(-LIMIT, LIMIT)

    def _walk(self, system: System) -> Walk:
        # the systems of one diagnosis share walls, radii and masses: the first stands for all
        if self._scene is None:
            check_model(system)
            self._scene = self.windows.scene(system)
        walk = Walk(self.windows, self._scene, system, self._tables)
        if walk.compiled:
            self._tables = walk.tables
        return walk

    def _turns(self) -> np.ndarray:
        """``(P, 2, 2)``: rows along and across each person's way in his window."""
        which, who = self.windows.person.T
        x = self.windows.batch.x[:, which, who].numpy()
        goal = self.windows.batch.destination[which, who].numpy()
        way, far = x[-1] - x[0], goal - x[0]
        slow = np.hypot(*way.T) < 0.1
        way = np.where(slow[:, None], far, way)
        way = way / np.maximum(np.hypot(*way.T), 1e-9)[:, None]
        return np.stack([way, np.stack([-way[:, 1], way[:, 0]], 1)], 1)
