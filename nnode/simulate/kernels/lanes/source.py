"""The compiled simulation of a lane and its exact gradient, as source text.

Numba cannot promise the compiler that two arrays do not overlap: all rows of a block therefore lie
in one array, at distances that are numbers when it is compiled. An increment of a state is

    I = move * (the formula where somebody is ahead, the leader's speed elsewhere),

and every step of every method adds increments; the gradient is made from this formula.
Where a formula names the speed of the vehicle ahead, vehicles are computed one behind the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from nnode.model.expression import Expr, apply, const, symbol, symbols
from nnode.model.lane_dynamics import LaneDynamics
from nnode.model.lane_rates import SAFE
from nnode.model.names import check_symbols
from nnode.model.text import plain
from nnode.simulate.kernels.lanes.templates import HEAD, SIMULATE
from nnode.simulate.kernels.loops import Loop

#: Weights and times of the stages of a method.
TABLEAUS = {
    "euler": ((1.0,), (0.0,)),
    "rk4": ((1 / 6, 1 / 3, 1 / 3, 1 / 6), (0.0, 0.5, 0.5, 1.0)),
}


@dataclass(frozen=True)
class LaneSource:
    """Source of a model.

    Attributes:
        lane: flat, its rates those of a step.
        stages: ``euler`` or ``rk4``.
        own: whether every simulation has parameters of its own.
        stride: numbers between two rows.
        forward_only: without the gradient.
    """

    lane: LaneDynamics
    stages: str = "euler"
    own: bool = False
    stride: int = 1424
    forward_only: bool = False

    @cached_property
    def states(self) -> list[str]:
        return list(self.lane.rates)

    @cached_property
    def parameters(self) -> list[str]:
        return list(self.lane.owned)

    @cached_property
    def recursive(self) -> bool:
        return bool(self.lane.chained)

    @cached_property
    def fields(self) -> list[str]:
        """What vehicles have from the data."""
        return [
            name for name in [*self.lane.inputs, "start", "length_1"] if name in self.lane.symbols
        ]

    @cached_property
    def measured(self) -> bool:
        """Whether the measured speed of leaders is needed."""
        return "measured" in self.lane.symbols or self.recursive

    @cached_property
    def inputs(self) -> list[str]:
        """Rows that carry derivatives."""
        ahead = [f"{s}_{j}" for s, j in self.lane.ahead]
        return [*self.states, *ahead, *self.lane.chained.values()]

    @cached_property
    def loop(self) -> Loop:
        return Loop([] if self.own else self.parameters)

    # -- formulas --------------------------------------------------------------------------------

    @cached_property
    def follower(self) -> dict[str, Expr]:
        """Row to formula of everybody but the first row."""
        behind, move = symbol("behind"), symbol("move")
        speed, found = self._leader(), {}
        for s, rate in self.lane.rates.items():
            every = apply("choose", behind, rate, speed if s == "x" else self._lead(s))
            if s in self.lane.chained:
                found[f"R_{s}"] = every
            found[f"I_{s}"] = move * every
        return found

    @cached_property
    def first(self) -> dict[str, Expr]:
        """Row to formula of the first row, where nobody is behind anybody."""
        speed = self._leader()
        found = {f"I_{s}": const(0) for s in self.states}
        found["I_x"] = symbol("first_move") * speed
        for s in self.lane.leads:
            found[f"I_{s}"] = symbol("first_move") * self._lead(s)
        for s in self.lane.chained:
            found[f"R_{s}"] = speed if s == "x" else self._lead(s)
        return found

    def _lead(self, state: str) -> Expr:
        """Rate of a leader's state other than its place."""
        rate = self.lane.leads.get(state, const(0))
        return apply("choose", symbol("drives"), rate, const(0)) if self.recursive else rate

    def _leader(self) -> Expr:
        """Speed of a leader; where its places are given it does not move by it."""
        if not self.recursive:
            return self.lane.leader
        return apply("choose", symbol("drives"), self.lane.leader, symbol("measured"))

    def _seeds(self, formulas: dict[str, Expr]) -> dict[Expr, Expr]:
        found: dict[Expr, Expr] = {}
        for row, node in formulas.items():
            weight = symbol("RBAR" if row == "R_x" else f"A_{row[2:]}")
            if not node.is_number():
                found[node] = found[node] + weight if node in found else weight
        return found

    # -- text ------------------------------------------------------------------------------------

    @cached_property
    def rows(self) -> list[str]:
        """All rows, states first, then what is one after the other for every state."""
        every = list(self.states)
        back = () if self.forward_only else ("A", *(f"Y{i}" for i in range(4)))
        for group in ("I", "E", "B", "S", *back):
            every += [f"{group}_{s}" for s in self.states]
        every += [f"{s}_{j}" for s, j in self.lane.ahead]
        every += ["behind", "second", "move", "first_move", "measured"]
        every += [*self.lane.chained.values(), *(f"R_{s}" for s in self.lane.chained)]
        every += self.fields
        if not self.forward_only:
            every += ["RBAR", *(f"D_{i}" for i in self.inputs if i not in self.states)]
        if self.own:
            every += [*self.parameters, *(f"G_{p}" for p in self.parameters)]
        return every

    def text(self) -> str:
        """The module's source.

        Raises:
            ConfigError: a name in the formulas that is no symbol.
        """
        check_symbols([*self.rows, *self.parameters, *self.lane.symbols])
        places = "".join(
            f"_{row} = np.uint64({i * self.stride})\n" for i, row in enumerate(self.rows)
        )
        weights, times = TABLEAUS[self.stages]
        formula = "\n".join(f"d{s}/dt = {plain(rate)}" for s, rate in self.lane.rates.items())
        formula += f"\nleader: {plain(self.lane.leader)}"
        head = HEAD.format(
            formula=formula, stride=self.stride, states=len(self.states),
            rows=len(self.rows), places=places, weights=weights, times=times,
        )  # fmt: skip
        text = head + self._gather() + self._rates()
        if not self.forward_only:
            text += self._pull()
        return text + self._own() + SIMULATE.format(**self._pieces())

    def _pieces(self) -> dict[str, str]:
        return {
            "measured": str(self.measured),
            "speeds": str(self.lane.order > 1),
            "own": str(self.own),
            "fields": _lines(
                2,
                *(
                    f"place(room[_{name}:], fields[{i}], low, width, w)"
                    for i, name in enumerate(self.fields)
                ),
            ),
            "ahead_back": "" if self.forward_only else self._ahead_back(),
        }

    def _gather(self) -> str:
        """What stands ahead of everybody; something harmless where there is nobody."""
        text = "\n\n@njit(**INLINE)\ndef gather(room, lo, n, w):\n"
        text += f"    zero, safe = real(0, room[0]), real({SAFE!r}, room[0])\n"
        for s, j in self.lane.ahead:
            own, mask = (s, "behind") if j == 1 else (f"{s}_1", "second")
            text += f"    there = room[_{s} + np.uint64(lo + {j} * w):]\n"
            text += f"    found = room[_{s}_{j} + np.uint64(lo):]\n"
            if s in self.lane.linear:
                # nothing is chosen by them, and what they are where nobody is goes nowhere
                text += "    copy(found, there, n)\n"
                continue
            away = "here[k] + safe" if s == "x" else "here[k]"
            text += (
                f"    here, mask = room[_{own} + np.uint64(lo):], room[_{mask} + np.uint64(lo):]\n"
                "    for k in range(n):\n"
                f"        found[k] = there[k] if mask[k] > zero else {away}\n"
            )
        if self.recursive:
            for s, ahead in self.lane.chained.items():
                text += (
                    f"    copy(room[_{ahead} + np.uint64(lo):], "
                    f"room[_R_{s} + np.uint64(lo + w):], n)\n"
                )
        return text + "    return\n"

    def _rates(self) -> str:
        text = self.loop.function("follow", self.follower) + self.loop.function("first", self.first)
        text += "\n\n@njit(**INLINE)\ndef rates(room, q, t, dt, drives, w, agents, total):\n"
        last = "    first(room, (agents - 1) * w, {n}, q, t, dt, drives, total)\n"
        if self.recursive:
            text += last.format(n="w")
            text += (
                "    for i in range(agents - 2, -1, -1):\n"
                "        gather(room, i * w, w, w)\n"
                "        follow(room, i * w, w, q, t, dt, drives, total)\n"
            )
        else:
            text += (
                "    n = padded((agents - 1) * w)\n"
                "    gather(room, 0, n, w)\n"
                "    follow(room, 0, n, q, t, dt, drives, total)\n" + last.format(n="padded(w)")
            )
        return text

    def _pull(self) -> str:
        """From adjoints A of increments to D, the adjoints of what they depend on."""
        # a state's own adjoint is read once, and can be replaced at once
        rows = {f"A_{s}": s for s in self.states}
        rows |= {f"D_{i}": i for i in self.inputs if i not in self.states}
        grads = {f"G_{p}": p for p in self.parameters} if self.own else {}
        kept = [f"A_{s}" for s in self.states] if self.stages != "rk4" else []
        onto = [*kept, *grads]
        text = self.loop.vjp("follow_pull", self._seeds(self.follower), {**rows, **grads}, onto)
        # of the first row only a leader's own speed can matter
        mine = [f"A_{s}" for s in self.states if not kept or s in symbols(self.first.values())]
        text += self.loop.vjp(
            "first_pull",
            self._seeds(self.first),
            {**{row: row[2:] for row in mine}, **grads},
            [*(row for row in mine if row in kept), *grads],
        )
        text += "\n\n@njit(**INLINE)\ndef pull(room, q, t, dt, drives, w, agents, total):\n"
        if self.recursive:
            text += (
                "    rates(room, q, t, dt, drives, w, agents, total)\n"
                "    room[_RBAR:_RBAR + S] = 0\n"
                "    for i in range(agents - 1):\n"
                "        follow_pull(room, i * w, w, q, t, dt, drives, total)\n"
                "        copy(room[_RBAR + np.uint64((i + 1) * w):], "
                "room[_D_dx_1 + np.uint64(i * w):], w)\n"
                "    first_pull(room, (agents - 1) * w, w, q, t, dt, drives, total)\n"
            )
        else:
            text += "    n = padded((agents - 1) * w)\n    gather(room, 0, n, w)\n"
            # followers' rows are computed in whole chunks, which reach into the first row: where
            # adjoints are replaced, and not added to, those of the first row wait in rows I
            waiting = [row for row in mine if row not in kept]
            at = "np.uint64((agents - 1) * w)"
            for row in waiting:
                text += f"    copy(room[_I_{row[2:]} + {at}:], room[_{row} + {at}:], w)\n"
            text += "    follow_pull(room, 0, n, q, t, dt, drives, total)\n"
            for row in waiting:
                text += f"    copy(room[_{row} + {at}:], room[_I_{row[2:]} + {at}:], w)\n"
            text += "    first_pull(room, (agents - 1) * w, padded(w), q, t, dt, drives, total)\n"
        return text

    def _ahead_back(self) -> str:
        """Adjoints of states ahead to those whose states they are."""
        text = ""
        for s, j in reversed(self.lane.ahead):
            if j == 2:
                text += (
                    f"    share, other, mask = room[_D_{s}_2:], room[_D_{s}_1:], room[_second:]\n"
                    "    for k in range((agents - 1) * w):\n"
                    "        other[k] = other[k] + (zero if mask[k] > zero else share[k])\n"
                    "        share[k] = share[k] if mask[k] > zero else zero\n"
                )
            text += (
                f"    target, share = room[_A_{s} + np.uint64({j} * w):], room[_D_{s}_{j}:]\n"
                f"    for k in range(max(agents - {j}, 0) * w):\n"
                "        target[k] = target[k] + share[k]\n"
            )
        return text

    def _own(self) -> str:
        """Parameters of every simulation into rows, and their gradients out of them."""
        text = "\n\n@njit(**SCALAR)\ndef spread_own(room, q, low, width, w, agents):\n"
        for i, p in enumerate(self.parameters if self.own else []):
            text += f"    spread(room[_{p}:], q[:, {i}], low, width, w, agents)\n"
        text += (
            "    return\n\n\n@njit(**SCALAR)\ndef collect_own(room, grad, low, width, w, agents):\n"
        )
        for i, p in enumerate(self.parameters if self.own else []):
            text += f"    collect(room[_G_{p}:], grad[:, {i}], low, width, w, agents)\n"
        return text + "    return\n"


def _lines(depth: int, *lines: str) -> str:
    return "".join(f"{'    ' * depth}{line}\n" for line in lines)
