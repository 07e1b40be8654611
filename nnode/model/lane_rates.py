"""The right-hand side of a lane from its formula, with PyTorch or with NumPy.

Arrays have vehicles first, so that the vehicles ahead are the next rows, and sequences last:
``(N, ..., B)``. What is written ``Array`` is a tensor or an array of NumPy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache, cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.model.arrays import Code, NumpyFunction, computed, numpy_function
from nnode.model.expression import Expr, topological
from nnode.model.terms import LaneDynamics

Array = Any
#: Values of a formula's symbols.
Values = dict[str, Any]
#: Gap that stands in for that of vehicles behind nobody, m.
SAFE = 20.0


class Formulas:
    """Formulas as a function of their symbols' values, tensors or arrays.

    Args:
        outputs: the formulas.
        given: parts of them whose values are given with those of the symbols.
    """

    def __init__(self, outputs: Sequence[Expr], given: Sequence[Expr] = ()) -> None:
        self.outputs, self.given = tuple(outputs), tuple(given)

    @cached_property
    def _numpy(self) -> NumpyFunction:
        return numpy_function(self.outputs, self.given)

    def __call__(
        self,
        values: Mapping[str, Array],
        known: Sequence[Array] = (),
        code: Mapping[str, Code] | None = None,
    ) -> list[Array]:
        """Their values.

        Args:
            known: values of the given parts. code: what calls stand for, of tensors alone.
        """
        if isinstance(next(iter(values.values())), Tensor):
            return computed(self.outputs, values, dict(zip(self.given, known, strict=True)), code)
        return self._numpy(values, tuple(known))


class Rates:
    """Formulas of rates, which may depend on the speed of the vehicle ahead, ``dx_1``.

    Args:
        outputs: the formulas.
        given: see :class:`Formulas`.

    Attributes:
        chained: whether a vehicle's rates depend on ``dx_1``, so that they are computed after
            those of the vehicle ahead.
        at_once: the rates of all vehicles; of chained ones the parts that ``after`` needs.
        after: chained rates from ``dx_1`` and these parts.
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
    """Those of followers, and of a leader that drives by itself."""
    return Rates(list(lane.rates.values())), Formulas([lane.leader])


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
        self.follows, self.leader = follower[:-1], leader
        self._formulas, self._lead = _formulas(lane)
        self.second = self.follows & follower[1:]
        self._second = 1.0 * self.second
        self._all_follow = not isinstance(follower, Tensor) and bool(self.follows.all())

    def symbols(self, t: Array, y: Array, measured: Array) -> Values:
        """Values ``(N - 1, ..., B)`` of what formulas of followers name, but for ``dx_1``.

        Args:
            t: s. y: ``(M, N, ..., B)`` states.
            measured: speeds of leaders, m/s.
        """
        library: Any = torch if isinstance(y, Tensor) else np
        states = dict(zip(self.lane.rates, y, strict=True))
        found = {name: every[:-1] for name, every in {**self.inputs, **states}.items()}
        found = {**self.values, **found, "t": t, "measured": measured, "second": self._second}
        for name, ahead in self.lane.ahead:
            value, safe = states[name][1:], SAFE if name == "x" else 0.0
            if ahead == 2:
                value = library.concatenate([states[name][2:], states[name][-1:]])
                value = library.where(self.second, value, found[f"{name}_1"] + safe)
            elif library is torch:  # derivatives of what nobody reads have to be finite
                value = library.where(self.follows, value, found[name] + safe)
            found[f"{name}_{ahead}"] = value
        return found

    def of_leaders(self, formulas: Formulas, y: Array, symbols: Values) -> list[Array]:
        """Formulas of leaders, who have nobody ahead, from the values of followers' symbols."""
        states = dict(zip(self.lane.rates, y, strict=True))
        every = {**symbols, **self.inputs, **states, "second": 0.0}
        for name, ahead in self.lane.ahead:
            every[f"{name}_{ahead}"] = states[name] + (ahead * SAFE if name == "x" else 0.0)
        return formulas(every, code=self._code)

    def __call__(self, y: Array, symbols: Values, lead: Array | None = None) -> Array:
        """``(M, N, ..., B)`` rates of the states.

        Args:
            y: their values. symbols: see :meth:`symbols`.
            lead: speeds of leaders; None: the formula tells them.
        """
        library: Any = torch if isinstance(y, Tensor) else np
        if lead is None:
            (lead,) = self.of_leaders(self._lead, y, symbols)
        if library is np:
            found = np.zeros_like(y)
            np.copyto(found[0], lead, where=self.leader)
            lead = found[0]
        else:
            lead = torch.where(self.leader, lead, 0.0).expand_as(y[0])
        rates = self._formulas.at_once(symbols, code=self._code)
        if self._formulas.chained:
            wide = [getattr(part, "ndim", 0) == y.ndim - 1 for part in rates]
            rows, ahead = [], lead[-1]
            for i in range(len(self.follows) - 1, -1, -1):
                here = [part[i] if w else part for part, w in zip(rates, wide, strict=True)]
                rows.append(self._formulas.after({"dx_1": ahead}, here, self._code))
                ahead = rows[-1][0]
                if not self._all_follow:
                    ahead = library.where(self.follows[i], ahead, lead[i])
            rates = [library.stack(row) for row in zip(*rows[::-1], strict=True)]
        if library is np:
            for own, rate in zip(found[:, :-1], rates, strict=True):
                np.copyto(own, rate, where=True if self._all_follow else self.follows)
            return found
        whole = []
        for rate, other in zip(rates, [lead, *[0.0 * lead] * (len(y) - 1)], strict=True):
            whole.append(torch.cat([torch.where(self.follows, rate, other[:-1]), other[-1:]]))
        return torch.stack(whole)
