"""Accelerations of people among the measured paths of the others, in compiled code.

The surroundings of person p are tables:

* ``others`` ``(H, W, 4, N)``: positions and velocities of the N people of W windows at H times;
* ``window`` ``(P,)``: the person's window;
* ``meets`` ``(P, N)``: 1 for everyone who acts on the person, else 0;
* ``wall`` ``(P, 4, M)``: nearby wall points and their normals, of which the first ``points[p]``
  are real;
* ``have`` ``(P, F)``: the person's properties, see ``FIELDS``;
* ``q`` ``(R, U)``: parameters of R runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

from nnode.model.expression import Expr, symbols
from nnode.model.terms import OTHERS, POINTS, SEEN, WALLS, CrowdDynamics
from nnode.simulation.kernels.loops import Loop
from nnode.simulation.kernels.runs import Source

#: Properties of a person in addition to the state.
FIELDS = ("goal_x", "goal_y", "pace", "people", "points")


@dataclass(frozen=True)
class WalkSource(Source):
    """Source code of a model.

    Attributes:
        law: flat, with sums over others, wall points and walls.
    """

    kind: ClassVar[str] = "walk"
    law: CrowdDynamics

    @cached_property
    def parameters(self) -> list[str]:
        """Symbols of a row of ``q``."""
        return [*self.law.owned, *self.law.settings]

    @cached_property
    def sums(self) -> dict[str, dict[str, Expr]]:
        """Kind of neighbours to the sums over them."""
        return {
            over: self.law.sums[over] for over in (OTHERS, POINTS, WALLS) if self.law.sums[over]
        }

    @cached_property
    def arguments(self) -> dict[str, list[str]]:
        """Arguments of the functions of summands, by kind of neighbours, and of the rate."""
        takes = {over: [*SEEN[over], "vx", "vy"] for over in self.sums}
        names = [name for summands in self.sums.values() for name in summands]
        return {**takes, "rate": ["x", "y", "vx", "vy", *names]}

    @property
    def names(self) -> list[str]:
        return [*self.parameters, *self.arguments["rate"], *self.law.symbols]

    def statements(self, outputs: Sequence[Expr]) -> tuple[list[str], list[str]]:
        """Lines that evaluate formulas of scalars, and the names of their values."""
        lines, results = Loop(self.parameters).statements(outputs)
        used = symbols(outputs)
        fields = [f"{field} = have[{i}]" for i, field in enumerate(FIELDS) if field in used]
        return [*fields, *lines], results
