"""What a method of stepping makes of a law of second order: a change of its formula.

Vehicles stop and do not drive backwards: where a step would end with a negative speed, it ends
with 0. All methods are then Euler's on the changed formula, but for ``rk4``, whose stages are
those of the changed formula.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from nnode.errors import ConfigError
from nnode.model.expression import Expr, apply, const, reciprocal, symbol
from nnode.model.terms import LaneDynamics

#: Methods of compiled code: Euler's; places with the new speed (SUMO's own); places with the mean
#: of both speeds (Treiber & Kanagaraj 2015); Runge and Kutta's of fourth order.
METHODS = ("euler", "semi_implicit", "ballistic", "rk4")
#: What those are in stages of Runge and Kutta's.
STAGES = {"euler": "euler", "semi_implicit": "euler", "ballistic": "euler", "rk4": "rk4"}
#: m/s; keeps a quotient of two numbers that are both 0 away.
_TINY = 1e-12


@cache
def stepped(lane: LaneDynamics, method: str) -> LaneDynamics:
    """A flat lane whose rates are those of one step of ``dt`` seconds.

    A speed never falls below 0: its rate is at least -v/dt. In a ballistic step in which a
    vehicle stops, it comes v²/(2 |a|) farther (Treiber & Kanagaraj 2015, section 3).

    Raises:
        ConfigError: a law that names ``dt``, a map from step to step, with stages in between.
    """
    if method == "rk4" and "dt" in lane.symbols:
        raise ConfigError(
            "the law names dt, the length of a step: it says what holds one step later, and "
            "solver.method=rk4 has stages in between; take euler, semi_implicit or ballistic"
        )
    if lane.order == 1:
        return lane
    v, dt = symbol("v"), symbol("dt")
    wanted = lane.rates["v"]
    rate = apply("max", -v * reciprocal(dt), wanted)
    place: Expr = v
    if method == "semi_implicit":
        place = v + dt * rate
    elif method == "ballistic":
        braked = apply("max", -dt * wanted, const(_TINY))
        stops = 0.5 * v * v * reciprocal(braked)
        place = apply("choose", v + dt * wanted, v + 0.5 * dt * wanted, stops)
    return replace(lane, rates={**lane.rates, "x": place, "v": rate})
