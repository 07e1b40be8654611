"""The compiled simulation of a crowd and its exact gradient, as source text.

A step of Euler's method has two parts: sums over the others, over wall points and over walls, in
which everybody meets everybody, or his neighbours; and accelerations of these sums. The gradients
of both are made from the formulas.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch

from nnode.model.arrays import computed
from nnode.model.crowd_dynamics import NOBODY, OTHERS, POINTS, SEEN, SMALLEST, WALLS, CrowdDynamics
from nnode.model.differentiate import derivatives
from nnode.model.expression import Expr, apply, symbol, symbols, topological
from nnode.model.names import check_symbols
from nnode.model.text import plain
from nnode.simulate.kernels.crowds.least import LEAST
from nnode.simulate.kernels.crowds.neurons import Feature, split
from nnode.simulate.kernels.crowds.rows import SIZE
from nnode.simulate.kernels.crowds.templates import (
    ARRANGE,
    DRIVE,
    HEAD,
    KNOW,
    MEET,
    NEURONS,
    OWN,
    PAIRS,
    SCENE,
)
from nnode.simulate.kernels.loops import Loop

_STATE = ("x", "y", "vx", "vy")
_POINT = ("x", "y", "normal_x", "normal_y")
_FIELDS = ("goal_x", "goal_y", "pace", "people", "points", "start")
#: Places of what is seen of others in the rows of states, and in the tables of walls.
_APART = ("dx", "dy", "dvx", "dvy")
_RELATIVE = {OTHERS: _APART, POINTS: ("dx", "dy"), WALLS: ("dx", "dy"), SMALLEST: _APART}
_COUNT = {POINTS: "points", WALLS: "walls"}
#: Who meets whom, in a driver: everybody everything, or pairs.
_PARTNERS = {
    False: {
        OTHERS: "length, here, y, here, width, first, shifts",
        POINTS: "length, here, rows_points, real_points, width, 0, points",
        WALLS: "length, here, rows_walls, real_walls, width, 0, walls",
    },
    True: {
        OTHERS: "own, pairs, meetings",
        POINTS: "barriers, touched, touches",
        WALLS: "solid, every, every.shape[1]",
    },
}


@dataclass(frozen=True)
class CrowdSource:
    """Source of a model.

    Attributes:
        law: flat.
        near: whether people meet their neighbours only; not with smallest values over others.
    """

    law: CrowdDynamics
    near: bool = False

    @cached_property
    def uniform(self) -> list[str]:
        """Symbols of the array ``q``."""
        return [*self.law.owned, *self.law.settings]

    @cached_property
    def _split(self) -> tuple[CrowdDynamics, dict[str, dict[str, Feature]]]:
        # pair by pair there is little to save
        return (self.law, {}) if self.near else split(self.law, self.uniform)

    @property
    def features(self) -> dict[str, dict[str, Feature]]:
        """Numbers of receivers and sources whose differences sums are made of, if they are."""
        return self._split[1]

    @cached_property
    def fields(self) -> list[str]:
        """What people have besides their states, in the rows behind those."""
        names = [*_FIELDS, *self.law.inputs]
        return [n for n in names if {n, f"{n}_j"} & self.law.symbols]

    @cached_property
    def own(self) -> list[str]:
        """All rows of a person."""
        return [*_STATE, *self.fields]

    @cached_property
    def over(self) -> dict[str, dict[str, Expr]]:
        """What sums run over, and these."""
        return {over: found for over, found in self._split[0].sums.items() if found}

    @cached_property
    def sums(self) -> list[str]:
        return [name for found in self.over.values() for name in found]

    @property
    def rows_of_sums(self) -> list[str]:
        """These, and who attains smallest values."""
        return [*self.sums, *(f"who_{name}" for name in self.over.get(SMALLEST, ()))]

    @cached_property
    def mutual(self) -> bool:
        """Whether partners do the opposite to each other, so that one of both tells it all."""
        found = list(self.over.get(OTHERS, {}).values())
        if OTHERS in self.features:
            return False
        return bool(found) and _opposite(found, [self.law.swapped(s) for s in found])

    @cached_property
    def kept(self) -> list[str]:
        """Sums on which the gradient depends by itself."""
        stored, ends = self.loop.adjoints(_seeds(self._rate), self._slopes_own)
        needed = [*stored.values(), *ends.values()]
        if SMALLEST in self.over:
            least = self.over[SMALLEST]
            stored, ends = self.loop.adjoints(_seeds(least), self._slopes(SMALLEST))
            needed += [*stored.values(), *ends.values()]
        inner = {*symbols(needed), *self.rows_of_sums[len(self.sums) :]}
        return [name for name in self.rows_of_sums if name in inner]

    # -- functions of rows -----------------------------------------------------------------------

    @cached_property
    def loop(self) -> Loop:
        return Loop(self.uniform, options="LOOP", fixed=tuple(self.law.settings))

    @cached_property
    def _rate(self) -> dict[str, Expr]:
        x, y = self._split[0].rate
        return {"O_x": x, "O_y": y}

    @cached_property
    def _slopes_own(self) -> dict[str, str]:
        return {f"D_{name}": name for name in (*_STATE, *self.sums)}

    @cached_property
    def rows(self) -> list[str]:
        """All rows of the room."""
        seen = [name for over in self.over for name in SEEN[over]]
        state = [*self.own, *dict.fromkeys(seen), *(f"{n}_j" for n in self.law.inputs)]
        weights = [f"W_{name}" for name in (*self.sums, "O_x", "O_y")]
        state += [z for found in self.features.values() for z in found]
        weights += [f"W_{z}" for found in self.features.values() for z in found]
        slopes = [f"D_{name}" for name in (*_STATE, *dict.fromkeys(seen), *self.sums)]
        return [*state, *self.sums, "O_x", "O_y", *weights, *slopes]

    def at(self, row: str) -> int:
        """Where a row begins."""
        return self.rows.index(row) * SIZE

    def text(self) -> str:
        """The module's source.

        Raises:
            ConfigError: a name in the formulas that is no symbol.
        """
        law = self.law
        check_symbols([*self.rows, *self.uniform, *law.symbols])
        state = "v" if law.order == 2 else ""
        lines = [f"d{state}{a}/dt = {plain(r)}" for a, r in zip("xy", law.rate, strict=True)]
        for over, found in self.over.items():
            what = "smallest over others of" if over == SMALLEST else f"sum over {over} of"
            lines += [f"{plain(symbol(n))} = {what} {plain(s)}" for n, s in found.items()]
        places = "".join(f"_{row} = np.uint64({self.at(row)})\n" for row in self.rows)
        kept = [[0, self.rows_of_sums.index(name)] for name in self.kept]
        places += f"KEPT = np.array({kept}, np.int64).reshape(-1, 2)\n"
        text = HEAD.format(formula="\n".join(lines), rows=len(self.rows), places=places)
        for over, found in self.over.items():
            if over in self.features:
                text += self._known(over)
                continue
            text += self._tables(over)
            text += self.loop.function(f"law_{over}", found)
            text += self.loop.vjp(f"law_{over}_pull", _seeds(found), self._slopes(over), [])
            if over == SMALLEST:
                text += LEAST.format(over=over, nobody=NOBODY)
                continue
            mutual = self.mutual and over == OTHERS
            text += PAIRS.format(over=over, mutual=mutual, moving=over == OTHERS)
            for name, rest in (("", "sums, reaction"), ("_pull", "weight, to_own, to_other")):
                text += MEET[self.near].format(name=f"{over}{name}", rest=rest, mutual=mutual)
        text += self._own_tables() + self.loop.function("law_own", self._rate)
        text += self.loop.vjp("law_own_pull", _seeds(self._rate), self._slopes_own, [])
        return text + OWN + DRIVE.format(**self._pieces())

    def _known(self, over: str) -> str:
        """Features of receivers and of sources, and their gradients."""
        text, found = "\n\n", self.features[over]
        for whose in ("own", "other"):
            formulas = {z: getattr(feature, whose) for z, feature in found.items()}
            columns = _STATE if over == OTHERS or whose == "own" else _POINT
            used = set(symbols(formulas.values()))
            takes = {n: i for i, n in enumerate(columns) if n in used}
            # walls do not move
            moves = columns is _STATE
            gives = {f"D_{n}": i for n, i in takes.items() if moves}
            name = f"{whose}_{over}"
            text += self._table(f"TAKES_{name}", takes) + self._table(f"GIVES_{name}", gives)
            text += self._table(f"PLACE_{name}", {n: i for n, i in takes.items() if i < 2})
            text += self.loop.function(f"know_{name}", formulas)
            slopes = {row: row[2:] for row in gives}
            text += self.loop.vjp(f"know_{name}_pull", _seeds(formulas), slopes, [])
            text += KNOW.format(name=name, over=over)
        first, z = self.sums.index(f"{over}_one"), symbol("z")
        value = apply(self.over[over][f"{over}_s0"].op, z)
        lines = {
            "value": self.loop.of_numbers("value", value),
            "slope": self.loop.of_numbers("slope", derivatives(value, ["z"])["z"]),
        }
        text += NEURONS.format(
            over=over, first=first, **{k: _lines(2, v).rstrip("\n") for k, v in lines.items()}
        )
        numbers = {z: i for i, z in enumerate(found)}
        text += self._table(f"KNOWN_{over}", numbers)
        return text + self._table(f"WEIGHED_{over}", {f"W_{z}": i for z, i in numbers.items()})

    def _slopes(self, over: str) -> dict[str, str]:
        used = set(symbols(self.over[over].values()))
        names = [n for n in (*_RELATIVE[over], *_STATE) if n in used]
        names += [n for n in self.sums if n in used]
        return {f"D_{name}": name for name in names}

    def _table(self, name: str, places: dict[str, int]) -> str:
        """Where rows begin in the room, and which rows they are outside it."""
        rows = [[self.at(row), place] for row, place in places.items()]
        return f"{name} = np.array({rows}, np.int64).reshape(-1, 2)\n"

    def _tables(self, over: str) -> str:
        """What a sum takes from receivers and sources, and what it gives back."""
        used, relative, seen = symbols(self.over[over].values()), _RELATIVE[over], [*SEEN[over]]
        apart = {n: relative.index(n) for n in used if n in relative}
        own = {n: self.own.index(n) for n in used if n in self.own}
        other = {n: seen.index(n) for n in used if n in seen and n not in relative}
        other |= {n: self.own.index(n[:-2]) for n in used if n.endswith("_j")}
        sums = {n: self.sums.index(n) for n in self.over[over]}
        found = {
            "APART": apart, "OWN": own, "OTHER": other, "SUMS": sums,
            "WEIGHTS": {f"W_{n}": i for n, i in sums.items() if not self.over[over][n].is_number()},
            "TO_BOTH": {f"D_{n}": place for n, place in apart.items()},
            "TO_OWN": {f"D_{n}": c for c, n in enumerate(_STATE) if n in used},
        }  # fmt: skip
        if over == SMALLEST:
            rows = self.rows_of_sums
            found["FROM"] = {n: i for i, n in enumerate(self.sums) if n in used}
            found["TO_FROM"] = {f"D_{n}": i for n, i in found["FROM"].items()}
            found["WHO"] = {n: rows.index(f"who_{n}") for n in self.over[over]}
            found["WEIGHTS"] = {f"W_{n}": i for n, i in sums.items()}
        return "\n\n" + "".join(self._table(f"{k}_{over}", v) for k, v in found.items())

    def _own_tables(self) -> str:
        """What accelerations take, and what their gradient gives back."""
        used = set(symbols(self._rate.values()))
        found = {
            "HAVE": {n: i for i, n in enumerate(self.own) if n in used},
            "MET": {n: i for i, n in enumerate(self.sums) if n in used},
            "RATE": {"O_x": 0, "O_y": 1},
            "WEIGHTS": {"W_O_x": 0, "W_O_y": 1},
            "TO_STATE": {f"D_{n}": i for i, n in enumerate(_STATE)},
            "TO_SUMS": {f"D_{n}": i for i, n in enumerate(self.sums)},
        }
        return "\n\n" + "".join(self._table(name, places) for name, places in found.items())

    # -- drivers ---------------------------------------------------------------------------------

    def _pieces(self) -> dict[str, object]:
        near, sums, width = self.near, len(self.rows_of_sums), len(self.own)
        barriers: list[str] = []
        meets: list[str] = []
        pulls = [] if near else [f"repeat(weighed, {sums}, length)"]
        for over in self.over:
            if over == SMALLEST:
                continue
            if near and over == POINTS:
                near_them = (
                    "touched, touches = points_near(own[0], own[1], barriers[0], barriers[1], "
                    "cells, start, cutoff_wall, touched)"
                )
                meets.append(near_them)
                pulls.append(near_them)
            elif not near and over != OTHERS:
                found = f"barrier(members, people, {_COUNT[over]}, table_{over})"
                barriers.append(f"rows_{over}, real_{over} = {found}")
            if over in self.features:
                self._of_neurons(over, barriers, meets, pulls)
                continue
            call = f"room, own, {_PARTNERS[near][over]}, q, time, dt, total"
            meets.append(f"meet_{over}({call}, sums, reaction)")
            pulls.append(f"meet_{over}_pull({call}, weighed, to_own, to_other)")
        if not near:
            meets += ["fold(sums, reaction, length)"] if self.mutual else []
            pulls.append("fold(to_own, to_other, length)")
        inner = {"width": width, "mutual": self.mutual}
        arrays = {
            "blank": ("blank", "scattered"),
            "reaction": (f"blank({sums}, 2 * length, y0)", "sums"),
            "weighed": (f"blank({sums}, 2 * length, grad_y0)",
                        f"scattered({sums}, length, grad_y0)"),
            "to_other": ("blank(4, 2 * length, grad_y0)", "to_own"),
        }  # fmt: skip
        return {
            **self._moving(),
            **{name: both[near] for name, both in arrays.items()},
            "scene": SCENE[near].format(**inner).strip("\n"),
            "arrange": ARRANGE[near].format(**inner).strip("\n"),
            "sums": sums, "kept_width": 4 + len(self.kept), "meets": _lines(3, meets),
            "pulls": _lines(3, pulls), "barriers": _lines(2, barriers),
        }  # fmt: skip

    def _moving(self) -> dict[str, str]:
        """How states move, and how their adjoints go back; smallest values."""
        second, least = self.law.order == 2, SMALLEST in self.over
        call = f"least_{SMALLEST}(room, y, length, here, width, q, time, dt, total, sums)"
        back = (
            f"least_{SMALLEST}_pull(room, y, length, width, q, time, dt, total, sums, weighed, "
            "to_own, to_other)"
        )
        return {
            "leasts": _lines(3, [call] if least else []),
            "least_pulls": _lines(3, [back] if least else []),
            "moved": "2 + c" if second else "c",
            "place": "y[c, t] += move[t] * y[2 + c, t]" if second else "pass",
            "placed": "adjoint[2 + c, t] += move[t] * adjoint[c, t]" if second else "pass",
        }

    def _of_neurons(self, over: str, before: list[str], meets: list[str], pulls: list[str]) -> None:
        """Features of everybody, from somebody's place on, for large numbers cost digits; sums of
        functions of their differences; and the gradients."""
        others = over == OTHERS
        number, rest = len(self.features[over]), "q, time, dt, total"
        size, rows = ("2 * length", "y") if others else (f"rows_{over}.shape[1]", f"rows_{over}")
        there, first, last = ("here", "first", "shifts") if others else (
            f"real_{over}", "0", _COUNT[over])  # fmt: skip
        before += [
            f"own_{over}, other_{over} = blank({number}, length, y), "
            f"blank({number}, {size} + LANES, y)",
            f"to_own_{over}, to_other_{over} = 0 * own_{over}, 0 * other_{over}",
        ]
        knowing = [
            f"all_own_{over}(room, y, y, length, {rest}, own_{over})",
            f"all_other_{over}(room, {rows}, y, {size}, {rest}, other_{over})",
        ]
        call = f"room, own_{over}, length, other_{over}, {there}, width, {first}, {last}, dt"
        meets += [*knowing, f"meet_{over}({call}, sums)"]
        pulls += [
            *knowing,
            f"clear(to_own_{over})",
            f"clear(to_other_{over})",
            f"meet_{over}_pull({call}, weighed, to_own_{over}, to_other_{over})",
            f"all_own_{over}_pull(room, y, y, length, {rest}, to_own_{over}, to_own)",
        ]
        to_other = f"to_other_{over}"
        if others:
            to_other, size = f"to_own_{over}", "length"
            pulls += [
                f"clear(to_own_{over})", f"fold(to_own_{over}, to_other_{over}, length)",
            ]  # fmt: skip
        back = f"all_other_{over}_pull(room, {rows}, y, {size}, {rest}, {to_other}, to_own)"
        pulls.append(back)


def _seeds(formulas: dict[str, Expr]) -> dict[Expr, Expr]:
    found: dict[Expr, Expr] = {}
    for row, node in formulas.items():
        weight = symbol(f"W_{row}")
        if not node.is_number():
            found[node] = found[node] + weight if node in found else weight
    return found


def _opposite(found: list[Expr], swapped: list[Expr]) -> bool:
    """Whether formulas are each other's opposite, tried at eight places."""
    generator = torch.Generator().manual_seed(0)
    values = {
        node.value: 0.5 * torch.randn(8, generator=generator, dtype=torch.float64)
        if node.value.startswith(("d", "v"))
        else 0.3 + torch.rand(8, generator=generator, dtype=torch.float64)
        for node in topological([*found, *swapped])
        if node.op == "symbol"
    }
    if not values:
        return False
    here, there = computed(found, values), computed(swapped, values)
    return all(
        torch.allclose(a, -b, rtol=1e-9, atol=1e-12) for a, b in zip(here, there, strict=True)
    )


def _lines(depth: int, lines: list[str]) -> str:
    return "".join(f"{'    ' * depth}{line}\n" for line in lines)
