"""Derivatives of simulated states by parameters, as further states of the same formula.

The tangent of a state s by a parameter p obeys d(s_p)/dt = sum over what the rate of s names of its
slope times that thing's tangent. A lane with its tangents is a lane again, which any method of
stepping simulates; its tangents are the exact derivatives of that method's states.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

from nnode.model.differentiate import derivatives
from nnode.model.expression import Expr, const, symbol, symbols
from nnode.model.terms import LaneDynamics


@cache
def with_tangents(lane: LaneDynamics, parameters: tuple[str, ...]) -> LaneDynamics:
    """A lane with the tangents of all its states by some of its parameters.

    Args:
        lane: flat; its rates those of a step, see :func:`nnode.model.steps.stepped`.
        parameters: symbols. The tangents by number i of them are the states ``{state}__d{i}``,
            all states' by the first one, then all states' by the second.
    """
    slopes = {state: _slopes(rate) for state, rate in lane.rates.items()}
    starts = {state: _slopes(start) for state, start in lane.starts.items()}
    lead = _slopes(lane.leader)
    rates, begun, leads = dict(lane.rates), dict(lane.starts), dict(lane.leads)
    chained = dict(lane.chained)
    for i, p in enumerate(parameters):
        moved = {p: const(1), **{s: symbol(f"{s}__d{i}") for s in lane.rates}}
        moved |= {f"{s}_{j}": symbol(f"{s}__d{i}_{j}") for s, j in lane.ahead}
        if lane.chained:
            moved["dx_1"] = symbol(f"dx_1__d{i}")
            chained[f"x__d{i}"] = f"dx_1__d{i}"
        for state in lane.rates:
            own = f"{state}__d{i}"
            rates[own] = _along(slopes[state], moved)
            if state in starts:
                begun[own] = _along(starts[state], {p: const(1)})
        leads[f"x__d{i}"] = _along(lead, moved)
    linear = frozenset(rates) - frozenset(lane.rates)
    return replace(lane, rates=rates, starts=begun, leads=leads, chained=chained, linear=linear)


def _slopes(formula: Expr) -> dict[str, Expr]:
    return derivatives(formula, sorted(symbols([formula])))


def _along(slopes: Mapping[str, Expr], moved: Mapping[str, Expr]) -> Expr:
    total = const(0)
    for name, slope in slopes.items():
        if name in moved:
            total = total + slope * moved[name]
    return total
