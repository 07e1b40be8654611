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

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from nnode.model.expression import Expr, symbols
from nnode.model.names import check_symbols
from nnode.model.terms import OTHERS, POINTS, SEEN, WALLS, CrowdDynamics
from nnode.model.text import plain
from nnode.simulation.kernels.loops import Loop
from nnode.simulation.kernels.runs import fill

#: Properties of a person in addition to the state.
FIELDS = ("goal_x", "goal_y", "pace", "people", "points")
_STATE = ("x", "y", "vx", "vy")
_SUMS = (OTHERS, POINTS, WALLS)


@dataclass(frozen=True)
class WalkSource:
    """Source code of a model.

    Attributes:
        law: flat, with sums over others, wall points and walls.
    """

    law: CrowdDynamics
    kind: ClassVar[str] = "walk"

    @property
    def parameters(self) -> list[str]:
        """Symbols of a row of ``q``."""
        return [*self.law.owned, *self.law.settings]

    def text(self) -> str:
        """The module's source.

        Raises:
            ConfigError: a name in the formulas is not a valid symbol.
        """
        law = self.law
        label = {name: f"{over}_{i}" for over in _SUMS for i, name in enumerate(law.sums[over])}
        check_symbols([*self.parameters, *label, *law.symbols])
        formula = [f"dv{axis}/dt = {plain(r)}" for axis, r in zip("xy", law.rate, strict=True)]
        text = ""
        values: dict[str, Any] = {}
        for over in _SUMS:
            summands = law.sums[over]
            formula += [f"{n} = sum over {over} of {plain(s)}" for n, s in summands.items()]
            text += self._function(f"of_{over}", (*SEEN[over], "vx", "vy"), summands.values())
            weight = "meets[j] * " if over == OTHERS else ""
            values[over] = _tuple([f"now_{label[name]}" for name in summands])
            values[f"add_{over}"] = [
                f"{label[name]} += {weight}now_{label[name]}" for name in summands
            ]
        text += self._function("rate", (*_STATE, *label), law.rate)
        zeros = [f"{name} = 0.0" for name in label.values()]
        state = "".join(f"{name}, " for name in (*_STATE, *label.values()))
        text += fill("walk", "drive", zeros=zeros, state=state, **values)
        return fill("walk", "head", formula="\n".join(formula)) + text

    def _function(self, name: str, takes: Sequence[str], outputs: Iterable[Expr]) -> str:
        """The source of a function that evaluates formulas of scalars."""
        outputs = list(outputs)
        loop, used = Loop(self.parameters), symbols(outputs)
        names = loop.names(outputs)
        lines = ["dt = zero = 0.0", *loop.given(outputs)]
        lines += [f"{field} = have[{i}]" for i, field in enumerate(FIELDS) if field in used]
        return fill(
            "walk",
            "function",
            name=name,
            takes=", ".join(takes),
            lines=[*lines, *loop.lines(names).values()],
            outputs=_tuple([names[node] for node in outputs]),
        )


def _tuple(names: Sequence[str]) -> str:
    """The source of a tuple."""
    return f"({', '.join(names)},)" if names else "()"
