"""The right-hand side of a lane from its formula, with PyTorch or with NumPy.

Arrays have vehicles first, so that the vehicles ahead are the next rows, and sequences last:
``(N, ..., B)``. What is written ``Array`` is a tensor or an array of NumPy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.model.arrays import numpy_function
from nnode.model.expression import Expr, topological
from nnode.model.lane_dynamics import LaneDynamics
from nnode.model.tensors import Code, computed

Array = Any
#: Values of a formula's symbols.
Values = dict[str, Any]
#: Gap that stands in for that of vehicles behind nobody, m.
SAFE = 20.0


def evaluated(
    outputs: tuple[Expr, ...],
    values: Mapping[str, Array],
    nodes: tuple[Expr, ...] = (),
    known: Sequence[Array] = (),
    code: Mapping[str, Code] | None = None,
) -> list[Array]:
    """Formulas from the values of their symbols, tensors or arrays.

    Args:
        nodes: parts of the formulas whose values are ``known``.
        code: what calls stand for, of tensors alone.
    """
    if isinstance(next(iter(values.values())), Tensor):
        return computed(outputs, values, dict(zip(nodes, known, strict=True)), code)
    return numpy_function(outputs, nodes)(values, tuple(known))


class Rates:
    """Formulas of rates, which may depend on the speed of the vehicle ahead, ``dx_1``.

    Args:
        outputs: the formulas.
        given: parts of them whose values are given with those of the symbols.

    Attributes:
        chained: whether a vehicle's rates depend on ``dx_1``, so that they are computed after
            those of the vehicle ahead.
    """

    def __init__(self, outputs: Sequence[Expr], given: tuple[Expr, ...] = ()) -> None:
        self.outputs, self.given = tuple(outputs), given
        parts = topological(self.outputs, set(given))
        chain: dict[Expr, None] = {}
        for part in parts:
            if part.value == "dx_1" or any(a in chain for a in part.args):
                chain[part] = None
        self.chained = bool(chain)
        needed = {a for part in chain for a in part.args} | set(self.outputs)
        #: parts that are computed for all vehicles at once
        self.ready = tuple(
            part
            for part in (*given, *parts)
            if part in needed and part not in chain and part.op != "const"
        )

    def at_once(
        self, values: Values, known: Sequence[Array] = (), code: Mapping[str, Code] | None = None
    ) -> list[Array]:
        """The rates; of chained ones the parts that do not depend on ``dx_1``."""
        outputs = self.ready if self.chained else self.outputs
        return evaluated(outputs, values, self.given, known, code)

    def after(
        self, ahead: Array, ready: Sequence[Array], code: Mapping[str, Code] | None = None
    ) -> list[Array]:
        """The rates of vehicles from the speed of the vehicle ahead and their other parts."""
        return evaluated(self.outputs, {"dx_1": ahead}, self.ready, ready, code)


@cache
def _rates(lane: LaneDynamics) -> Rates:
    return Rates(list(lane.rates.values()))


class LaneRates:
    """The right-hand side of a lane in its surroundings.

    Args:
        lane: flat.
        values: of symbols that are the same for all vehicles.
        inputs: ``(N, ..., B)`` of what vehicles have from the data.
        follower: ``(N, ..., B)`` True for vehicles behind another one.
        leader: ``(N, ..., B)`` True for those in front.
        code: what calls stand for.
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
        self.lane, self.values, self.inputs, self._code = lane, values, inputs, code
        self.follows, self.leader, self._formulas = follower[:-1], leader, _rates(lane)
        self.second = self.follows & follower[1:]

    def symbols(self, t: Array, y: Array, measured: Array) -> Values:
        """Values ``(N - 1, ..., B)`` of what formulas of followers name, but for ``dx_1``.

        Args:
            t: s. y: ``(M, N, ..., B)`` states.
            measured: speeds of leaders, m/s.
        """
        library: Any = torch if isinstance(y, Tensor) else np
        states = dict(zip(self.lane.rates, y, strict=True))
        found = {name: every[:-1] for name, every in {**self.inputs, **states}.items()}
        found = {**self.values, **found, "t": t, "measured": measured, "second": 1.0 * self.second}
        for name, ahead in self.lane.ahead:
            value, safe = states[name][1:], SAFE if name == "x" else 0.0
            if ahead == 2:
                value = library.concatenate([states[name][2:], states[name][-1:]])
                value = library.where(self.second, value, found[f"{name}_1"] + safe)
            elif library is torch:  # derivatives of what nobody reads have to be finite
                value = library.where(self.follows, value, found[name] + safe)
            found[f"{name}_{ahead}"] = value
        return found

    def of_leaders(self, formulas: tuple[Expr, ...], y: Array, symbols: Values) -> list[Array]:
        """Formulas of leaders, who have nobody ahead, from the values of followers' symbols."""
        states = dict(zip(self.lane.rates, y, strict=True))
        every = {**symbols, **self.inputs, **states, "second": 0.0}
        for name, ahead in self.lane.ahead:
            every[f"{name}_{ahead}"] = states[name] + (ahead * SAFE if name == "x" else 0.0)
        return evaluated(formulas, every, code=self._code)

    def __call__(self, y: Array, symbols: Values, lead: Array | None = None) -> Array:
        """``(M, N, ..., B)`` rates of the states.

        Args:
            y: their values. symbols: see :meth:`symbols`.
            lead: speeds of leaders; None: the formula tells them.
        """
        library: Any = torch if isinstance(y, Tensor) else np
        if lead is None:
            (lead,) = self.of_leaders((self.lane.leader,), y, symbols)
        lead = library.broadcast_to(library.where(self.leader, lead, 0.0), y[0].shape)
        others = [lead, *[library.zeros_like(lead)] * (len(y) - 1)]
        ready = self._formulas.at_once(symbols, code=self._code)
        if not self._formulas.chained:
            rates = []
            for rate, other in zip(ready, others, strict=True):
                own = library.where(self.follows, rate, other[:-1])
                rates.append(library.concatenate([own, other[-1:]]))
            return library.stack(rates)
        rows = [[other[-1] for other in others]]
        wide = [getattr(part, "ndim", 0) == y.ndim - 1 for part in ready]
        for i in range(len(self.follows) - 1, -1, -1):
            here = [part[i] if w else part for part, w in zip(ready, wide, strict=True)]
            found = self._formulas.after(rows[-1][0], here, self._code)
            rows.append(
                [
                    library.where(self.follows[i], rate, other[i])
                    for rate, other in zip(found, others, strict=True)
                ]
            )
        return library.stack([library.stack(rates) for rates in zip(*rows[::-1], strict=True)])
