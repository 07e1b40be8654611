"""The right-hand side of a lane from its formula, with PyTorch or with NumPy.

The first axis of arrays is the vehicle, the last is the sequence: ``(N, ..., B)``. The vehicle
ahead is the next row. ``Array`` stands for a tensor or a NumPy array.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.model.arrays import Code, Formulas
from nnode.model.expression import Expr, topological
from nnode.model.terms import LaneDynamics

Array = Any
#: Values of a formula's symbols.
Values = dict[str, Any]
#: Gap of vehicles without a vehicle ahead, m. It keeps their unused rates finite.
SAFE = 20.0


class Rates:
    """Formulas of rates, which may depend on the speed of the vehicle ahead, ``dx_1``.

    Args:
        outputs: the formulas.
        given: see :class:`Formulas`.

    Attributes:
        chained: whether a vehicle's rates depend on ``dx_1``. They are then computed after the
            rates of the vehicle ahead.
        at_once: the rates of all vehicles, or for chained rates the nodes that ``after`` needs.
        after: chained rates from ``dx_1`` and these nodes.
    """

    def __init__(self, outputs: Sequence[Expr], given: Sequence[Expr] = ()) -> None:
        parts = topological(outputs, set(given))
        chain: dict[Expr, None] = {}
        for part in parts:
            if part.value == "dx_1" or any(a in chain for a in part.args):
                chain[part] = None
        self.chained = bool(chain)
        needed = {*outputs, *(a for part in chain for a in part.args)} - set(chain)
        ready = [part for part in (*given, *parts) if part in needed and part.op != "const"]
        self.at_once = Formulas(ready if self.chained else outputs, given)
        self.after = Formulas(outputs, ready)


@cache
def _formulas(lane: LaneDynamics) -> tuple[Rates, Formulas]:
    """The rates of followers, and the speed of a leader that drives by the law."""
    return Rates(list(lane.rates.values())), Formulas([lane.leader])


class LaneRates:
    """The right-hand side of a lane in its surroundings.

    Args:
        lane: the flat formula.
        values: values of symbols that all vehicles share.
        inputs: symbol to the values ``(N, ..., B)`` of vehicles' properties from the data.
        follower: ``(N, ..., B)`` True for vehicles behind another vehicle.
        leader: ``(N, ..., B)`` True for the first vehicles.
        code: name to the function that calls of this name evaluate.
    """

    def __init__(
        self,
        lane: LaneDynamics,
        values: Values,
        inputs: Mapping[str, Array],
        follower: Array,
        leader: Array,
        code: Mapping[str, Code] | None = None,
    ) -> None:
        self.lane, self.inputs, self._code = lane, inputs, code
        self.follows, self.leader = follower[:-1], leader
        self._formulas, self._lead = _formulas(lane)
        self.second = self.follows & follower[1:]
        rows = {name: every[:-1] for name, every in inputs.items()}
        self._fixed = {**values, **rows, "second": 1.0 * self.second}
        self._library: Any = torch if isinstance(follower, Tensor) else np
        self._all_follow = self._library is np and bool(self.follows.all())

    def symbols(self, t: Array, y: Array, measured: Array) -> Values:
        """Values ``(N - 1, ..., B)`` of the symbols in followers' formulas except ``dx_1``.

        Args:
            t: s. y: ``(M, N, ..., B)`` states.
            measured: speeds of leaders, m/s.
        """
        library, states = self._library, dict(zip(self.lane.rates, y, strict=True))
        values = {**self._fixed, "t": t, "measured": measured}
        for name, every in states.items():
            values[name] = every[:-1]
        for name, ahead in self.lane.ahead:
            value, safe = states[name][1:], SAFE if name == "x" else 0.0
            if ahead == 2:
                value = library.concatenate([states[name][2:], states[name][-1:]])
                value = library.where(self.second, value, values[f"{name}_1"] + safe)
            elif library is torch:  # unused rates need finite derivatives
                value = library.where(self.follows, value, values[name] + safe)
            values[f"{name}_{ahead}"] = value
        return values

    def of_leaders(self, formulas: Formulas, y: Array, symbols: Values) -> list[Array]:
        """The values of leaders' formulas, with vehicles ahead at the gap ``SAFE``."""
        states = dict(zip(self.lane.rates, y, strict=True))
        every = {**symbols, **self.inputs, **states, "second": 0.0}
        for name, ahead in self.lane.ahead:
            every[f"{name}_{ahead}"] = states[name] + (ahead * SAFE if name == "x" else 0.0)
        return formulas(every, code=self._code)

    def __call__(self, y: Array, symbols: Values, lead: Array | None = None) -> Array:
        """``(M, N, ..., B)`` rates of the states.

        Args:
            y: ``(M, N, ..., B)`` states. symbols: see :meth:`symbols`.
            lead: speeds of leaders, m/s; None computes them by the formula.
        """
        library = self._library
        if lead is None:
            (lead,) = self.of_leaders(self._lead, y, symbols)
        if library is np:
            result = np.zeros_like(y)
            np.copyto(result[0], lead, where=self.leader)
            lead = result[0]
        else:
            lead = torch.where(self.leader, lead, 0.0).expand_as(y[0])
        rates = self._formulas.at_once(symbols, code=self._code)
        if self._formulas.chained:
            wide = [getattr(part, "ndim", 0) == y.ndim - 1 for part in rates]
            rows, ahead = [], lead[-1]
            for i in range(len(self.follows) - 1, -1, -1):
                row_parts = [part[i] if w else part for part, w in zip(rates, wide, strict=True)]
                rows.append(self._formulas.after({"dx_1": ahead}, row_parts, self._code))
                ahead = rows[-1][0]
                if not self._all_follow:
                    ahead = library.where(self.follows[i], ahead, lead[i])
            rates = [library.stack(row) for row in zip(*rows[::-1], strict=True)]
        if library is np:
            for target, rate in zip(result[:, :-1], rates, strict=True):
                if self._all_follow:
                    target[...] = rate
                else:
                    np.copyto(target, rate, where=self.follows)
            return result
        columns = []
        for rate, other in zip(rates, [lead, *[0.0 * lead] * (len(y) - 1)], strict=True):
            columns.append(torch.cat([torch.where(self.follows, rate, other[:-1]), other[-1:]]))
        return torch.stack(columns)
