"""Derivatives of simulated states by parameters, as additional states of the same formula.

The tangent of a state s by a parameter p obeys d(s_p)/dt = sum over the symbols q in the rate of s
of (d rate / dq) q_p. A lane with its tangents is again a lane, which any method of stepping
simulates. Its tangents are the exact derivatives of the states by that method.
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
        lane: flat, with the rates of a step, see :func:`nnode.model.steps.stepped`.
        parameters: symbols. The tangents by the i-th symbol are the states ``{state}__d{i}``, for
            all states by the first symbol, then for all states by the second.
    """
    slopes = {state: _slopes(rate) for state, rate in lane.rates.items()}
    starts = {state: _slopes(start) for state, start in lane.starts.items()}
    lead = _slopes(lane.leader)
    rates, start_values, leader_rates = dict(lane.rates), dict(lane.starts), dict(lane.leader_rates)
    chained = dict(lane.chained)
    for i, p in enumerate(parameters):
        moved = {p: const(1), **{s: symbol(f"{s}__d{i}") for s in lane.rates}}
        moved |= {f"{s}_{j}": symbol(f"{s}__d{i}_{j}") for s, j in lane.ahead}
        if lane.chained:
            moved["dx_1"] = symbol(f"dx_1__d{i}")
            chained[f"x__d{i}"] = f"dx_1__d{i}"
        for state in lane.rates:
            tangent = f"{state}__d{i}"
            rates[tangent] = _along(slopes[state], moved)
            if state in starts:
                start_values[tangent] = _along(starts[state], {p: const(1)})
        leader_rates[f"x__d{i}"] = _along(lead, moved)
    linear = frozenset(rates) - frozenset(lane.rates)
    return replace(
        lane,
        rates=rates,
        starts=start_values,
        leader_rates=leader_rates,
        chained=chained,
        linear=linear,
    )


def _slopes(formula: Expr) -> dict[str, Expr]:
    return derivatives(formula, sorted(symbols([formula])))


def _along(slopes: Mapping[str, Expr], moved: Mapping[str, Expr]) -> Expr:
    total = const(0)
    for name, slope in slopes.items():
        if name in moved:
            total = total + slope * moved[name]
    return total
