"""Stepping methods for laws of second order, expressed as changes of the law's formula.

Vehicles stop and do not drive backwards: a step that would end with a negative speed ends with
speed 0. Every method is Euler's method on the changed formula, except ``rk4``, which applies the
Runge-Kutta method to it.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from nnode.errors import ConfigError
from nnode.model.expression import Expr, apply, const, reciprocal, symbol
from nnode.model.terms import LaneDynamics

#: Methods: Euler; positions by the new speed (SUMO's default); positions by the mean of old and
#: new speed (Treiber & Kanagaraj 2015); the fourth-order Runge-Kutta method.
METHODS = ("euler", "semi_implicit", "ballistic", "rk4")
#: Method to the Runge-Kutta scheme that integrates its changed formula.
STAGES = {"euler": "euler", "semi_implicit": "euler", "ballistic": "euler", "rk4": "rk4"}
#: Smallest denominator, m/s; avoids 0/0.
_TINY = 1e-12


@cache
def stepped(lane: LaneDynamics, method: str) -> LaneDynamics:
    """A flat lane whose rates are those of one step of ``dt`` seconds.

    A speed never falls below 0, since its rate is at least -v/dt. In a ballistic step in which a
    vehicle stops, it moves v²/(2 |a|) (Treiber & Kanagaraj 2015, section 3).

    Raises:
        ConfigError: the law names ``dt``, and the method has intermediate stages.
    """
    if method == "rk4" and lane.is_map:
        raise ConfigError(
            "the law names dt, the length of a step: it says what holds one step later, and "
            "solver.method=rk4 has stages in between; take euler, semi_implicit or ballistic"
        )
    if lane.order == 1:
        return lane
    v, dt = symbol("v"), symbol("dt")
    acceleration = lane.rates["v"]
    rate = apply("max", -v * reciprocal(dt), acceleration)
    place: Expr = v
    if method == "semi_implicit":
        place = v + dt * rate
    elif method == "ballistic":
        braked = apply("max", -dt * acceleration, const(_TINY))
        stops = 0.5 * v * v * reciprocal(braked)
        place = apply("choose", v + dt * acceleration, v + 0.5 * dt * acceleration, stops)
    return replace(lane, rates={**lane.rates, "x": place, "v": rate})
