"""How simulated platoons respond to small changes, without simulating each of them."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Protocol

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.func import jvp, vmap

from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Batch
from nnode.discover.lanes.along import Along
from nnode.discover.lanes.bent import Bend, Bent, motion_of
from nnode.discover.lanes.motion import Motion, slopes
from nnode.discover.lanes.sweep import Sweep
from nnode.model.scene import Scene
from nnode.model.system import System


class _Linear(Protocol):
    """The linearised equations along the paths of a run."""

    def moved(self, source: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
        """``(K, N, C, B)`` m: positions moved by changes of the rates, see :class:`Sweep`."""
        ...


class Dense:
    """The equations of :class:`Sweep` where everybody may depend on everybody.

    Args:
        matrix: ``(K, B, M N, M N)`` derivatives of the rates by the states, one state of all
            vehicles after the other.
        width: M.
        dt: sampling interval, s.
    """

    def __init__(self, matrix: Tensor, width: int, dt: float) -> None:
        half, one = dt / 2, torch.eye(matrix.shape[-1], dtype=torch.float64)
        self._half, self._width = half, width
        # a model that blows up may have no solution: what it moves is then no number
        lu, pivots, _ = torch.linalg.lu_factor_ex(one - half * matrix[1:])
        self._factors = lu, pivots
        self._before = one + half * matrix[:-1]

    def moved(self, source: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
        k, w, n, c, b = source.shape
        every = np.zeros((k, self._width, n, c, b))
        every[:, :w] = source
        flat = torch.from_numpy(every).flatten(1, 2).permute(0, 3, 1, 2)
        forced = self._half * (flat[1:] + flat[:-1])
        state = flat.new_zeros(flat.shape[1:])
        if start is not None:
            state = torch.from_numpy(start).flatten(0, 1).permute(2, 0, 1).contiguous()
        found = [state]
        lu, pivots = self._factors
        for step in range(k - 1):
            right = self._before[step] @ state + forced[step]
            state = torch.linalg.lu_solve(lu[step], pivots[step], right)
            found.append(state)
        moved: np.ndarray = torch.stack(found)[:, :, :n].permute(0, 2, 3, 1).numpy()
        return moved


class Response:
    """The linearised equations along the paths of one run.

    With A the derivative of the rates with respect to the states, a change s of the rates moves
    the states by d' = A d + s, d = 0 at the start. The trapezoidal rule solves this at the
    sampling times: vehicle by vehicle where the model is a formula, otherwise for all at once.

    Args:
        system: the model, with the run's parameters.
        batch: the sequences. scene: their surroundings, with the step of the run.
        states: ``(K, B, N, W)`` of the run at the sampling times.
    """

    def __init__(self, system: System, batch: Batch, scene: Scene, states: Tensor) -> None:
        self.system, self.batch, self.states = system, batch, states
        self.along = Along(scene, states)
        self._motion = motion_of(system, scene)
        self._bend: Bend | None = None
        width = states.shape[-1]
        self._linear: _Linear
        with np.errstate(all="ignore"):
            if self._motion is None:
                self._linear = Dense(self._by_code(), width, batch.dt)
                return
            y, given = self.along.given(self._motion)
            base = Motion.rates(self._motion, y, given)
            self._slopes = slopes(self._motion, given, base)
            if not isinstance(self._motion, Bent):
                self._linear = Sweep(self._slopes, width, batch.dt)
                return
            self._bend = Bend(self._motion, y, base, given["t"], self._slopes)
            size = width * y.shape[1]
            matrix = self._bend.matrix.reshape(size, size, *y.shape[2:]).transpose(2, 3, 0, 1)
            self._linear = Dense(torch.from_numpy(matrix.copy()), width, batch.dt)

    @np.errstate(all="ignore")
    def moved(self, source: Tensor, start: Tensor | None = None) -> Tensor:
        """``(C, K, B, N)`` m: positions moved by changes of the rates.

        Args:
            source: ``(C, K, B, N, W)`` changes of the rates, m/s for positions; of the first
                states alone where the others' do not change.
            start: ``(C, B, N, W)`` changes of the states at the start, by default none.
        """
        first = None if start is None else start.permute(3, 2, 0, 1).contiguous().numpy()
        found = self._linear.moved(source.permute(1, 4, 3, 0, 2).contiguous().numpy(), first)
        return torch.from_numpy(found).permute(2, 0, 3, 1)

    def parameters(self) -> Tensor:
        """``(C, K, B, N)`` m per unit of each parameter that is calibrated."""
        own = ParameterVector(self.system).parameters
        source = self._sources_by_code() if self._motion is None else self._sources(self._motion)
        return self.moved(source, self._starts(own))

    def _sources(self, motion: Motion) -> Tensor:
        """``(C, K, B, N, W)`` derivatives of the rates by the parameters."""
        slopes, width = self._slopes, self.states.shape[-1]
        entries = {
            entry: c for c, entry in enumerate(_entries(ParameterVector(self.system).parameters))
        }
        n, times, sequences = len(motion.leads), len(self.states), len(self.batch)
        found = np.zeros((len(entries), width, n, times, sequences))
        for symbol, (name, place, _) in motion.lane.owned.items():
            c = entries.get((name, place))
            if c is None:
                continue  # it is not calibrated
            for p in range(width):
                if (p, symbol) in slopes.parameters:
                    found[c, p, :-1] += slopes.parameters[p, symbol]
            if symbol in slopes.lead:
                found[c, 0] += np.where(motion.leads, slopes.lead[symbol], 0.0)
        for i in range(n - 2, -1, -1):
            for p, slope in slopes.chain.items():
                found[:, p, i] += slope[i] * found[:, 0, i + 1]
        if self._bend is not None:
            assert isinstance(motion, Bent)
            for own in found:
                own[motion.top] += self._bend.passed_on(own[0])
            found[entries[motion.name, 0], motion.top] = self._bend.height
        return torch.from_numpy(found).permute(0, 3, 4, 2, 1)

    def _starts(self, own: Mapping[str, Tensor]) -> Tensor | None:
        """``(C, B, N, W)`` derivatives of the states at the start; None: they are measured."""
        if self.states.shape[-1] == self.system.order:
            return None
        found = []
        for name, place in _entries(own):
            system = copy.deepcopy(self.system)
            with forward_ad.dual_level():
                path, _, leaf = name.rpartition(".")
                module, value = system.get_submodule(path), own[name].detach()
                along = torch.zeros(value.numel(), dtype=value.dtype)
                along[place] = 1.0
                del module._parameters[leaf]
                setattr(module, leaf, forward_ad.make_dual(value, along.reshape(value.shape)))
                with torch.no_grad():
                    start = system.initial(self.batch)
                change = forward_ad.unpack_dual(start).tangent
                found.append(torch.zeros_like(start) if change is None else change)
        return torch.stack(found)

    # -- models with terms that are code ---------------------------------------------------------

    def _by_code(self) -> Tensor:
        """``(K, B, W N, W N)`` derivatives of the rates by the states."""
        k, b, n, w = self.states.shape
        rates = self.along.by_code(self.system)
        ways = torch.eye(n * w, dtype=torch.float64).reshape(w * n, 1, 1, w, n).transpose(-1, -2)

        def moving(way: Tensor) -> Tensor:
            found: Tensor = jvp(rates, (self.states,), (way.expand(self.states.shape),))[1]
            return found

        matrix: Tensor = vmap(moving)(ways).transpose(-1, -2).reshape(n * w, k, b, n * w)
        return matrix.permute(1, 2, 3, 0)

    def _sources_by_code(self) -> Tensor:
        """As :meth:`_sources`."""
        own = {name: p.detach() for name, p in ParameterVector(self.system).parameters.items()}

        def rates(parameters: dict[str, Tensor]) -> Tensor:
            return self.along.by_code(self.system, parameters)(self.states)

        sources = []
        for name, place in _entries(own):
            change = {n: torch.zeros_like(v) for n, v in own.items()}
            change[name].view(-1)[place] = 1.0
            sources.append(jvp(rates, (own,), (change,))[1])
        return torch.stack(sources)


def _entries(own: Mapping[str, Tensor]) -> list[tuple[str, int]]:
    """The parameters' names and the places in them, as in a row."""
    return [(name, place) for name, value in own.items() for place in range(value.numel())]
