"""Loops over rows of numbers, as source text for Numba.

What does not vary along a row is computed once before the loop; sums over the loop are pulled
back through it after the loop.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from nnode.model.differentiate import vjp
from nnode.model.expression import Expr, const, symbol, symbols, topological
from nnode.model.operations import OPERATIONS

_PAIR = ("softplus", "softplus_slope")


@dataclass(frozen=True)
class Loop:
    """What loops know.

    Attributes:
        uniform: symbols that are the same along a row, in the order of the array ``q``.
        scalars: others of them, which the function's arguments are called.
        options: of the compiler, by their name in the module.
        fixed: uniform symbols by which nobody wants a gradient.
    """

    uniform: Sequence[str]
    scalars: Sequence[str] = ("t", "dt", "drives")
    options: str = "INLINE"
    fixed: Sequence[str] = ()

    def varies(self, nodes: Sequence[Expr]) -> dict[Expr, bool]:
        """Node to whether it varies along a row."""
        same = {*self.uniform, *self.scalars}
        found: dict[Expr, bool] = {}
        for node in topological(nodes):
            own = node.op == "symbol" and node.value not in same
            found[node] = own or any(found[a] for a in node.args)
        return found

    def function(
        self,
        name: str,
        rows: Mapping[str, Expr],
        sums: Mapping[str, Expr] | None = None,
        after: Sequence[str] = (),
    ) -> str:
        """A function ``name(room, lo, n, q, t, dt, drives, total)`` that computes rows.

        Args:
            rows: row to what is stored there.
            sums: label to what is summed over the loop, in ``sum_label``.
            after: lines after the loop.
        """
        sums = sums or {}
        outputs = [*rows.values(), *sums.values()]
        varies = self.varies(outputs)
        names = self.names(outputs)
        before, inside = self.lines(topological(outputs), varies, names)
        read = [n.value for n in topological(outputs) if n.op == "symbol" and varies[n]]
        text = f"\n\n@njit(**{self.options})\ndef {name}(room, lo, n, q, t, dt, drives, total):\n"
        text += "    zero = real(0, dt)\n"
        text += self.given(outputs)
        text += _indented(before, 1)
        text += "".join(f"    sum_{label} = zero\n" for label in sums)
        text += "    for j in range(np.uint64(n)):\n        k = np.uint64(lo) + j\n"
        text += "".join(f"        {row} = room[k + _{row}]\n" for row in read)
        text += _indented(inside, 2)
        text += "".join(f"        room[k + _{row}] = {names[n]}\n" for row, n in rows.items())
        text += "".join(f"        sum_{s} = add(sum_{s}, {names[n]})\n" for s, n in sums.items())
        return text + _indented(after, 1)

    def given(self, outputs: Sequence[Expr]) -> str:
        """Lines that name the uniform quantities that formulas need."""
        needed = {n.value for n in topological(outputs) if n.op == "symbol"}
        found = [(p, j) for j, p in enumerate(self.uniform) if p in needed]
        return "".join(f"    {p} = q[{j}]\n" for p, j in found)

    def pulled(
        self, name: str, seeds: Mapping[Expr, Expr], rows: Mapping[str, str], onto: Sequence[str]
    ) -> str:
        """A function that adds to ``total`` the gradient by the uniform quantities, and stores
        that by others.

        Args:
            seeds: outputs to their weights.
            rows: row to the symbol whose adjoint is stored there.
            onto: rows whose adjoints are added to what they hold.
        """
        stored, ends = self.adjoints(seeds, rows)
        stored.update({row: symbol(row) + stored[row] for row in onto})
        sums = {str(i): total for i, total in enumerate(ends.values())}
        rest = vjp({node: symbol(f"sum_{i}") for i, node in enumerate(ends)}, lambda node: False)
        found = {
            n.value: b
            for n, b in rest.items()
            if n.op == "symbol" and n.value in self.uniform and n.value not in self.fixed
        }
        # what the chain behind the loop needs is computed there
        outputs = list(found.values())
        names = {
            **self.names(outputs, "u"),
            **{symbol(f"sum_{i}"): f"sum_{i}" for i in range(len(ends))},
        }
        lines, _ = self.lines(
            topological(outputs), dict.fromkeys(topological(outputs), False), names
        )
        after = self.given(outputs).replace("    ", "").splitlines() + lines
        after += [f"total[{self.uniform.index(p)}] += {names[b]}" for p, b in found.items()]
        return self.function(name, stored, sums, after)

    def adjoints(
        self, seeds: Mapping[Expr, Expr], rows: Mapping[str, str]
    ) -> tuple[dict[str, Expr], dict[Expr, Expr]]:
        """What is stored in rows, and what is summed over the loop of every node that does not
        vary in it."""
        varies = self.varies([*seeds, *seeds.values()])
        bar = vjp(seeds, lambda node: not varies[node])
        stored = {row: bar.get(symbol(own), const(0)) for row, own in rows.items()}
        still = {*self.fixed, *self.scalars}
        ends = {n: b for n, b in bar.items() if not varies[n] and not set(symbols([n])) <= still}
        return stored, ends

    def of_numbers(self, formulas: Mapping[str, Expr]) -> list[str]:
        """Lines that compute formulas of numbers by their names."""
        parts = topological(formulas.values())
        names = self.names(parts)
        lines, _ = self.lines(parts, dict.fromkeys(parts, False), names)
        return lines + [f"{name} = {names[node]}" for name, node in formulas.items()]

    def names(self, outputs: Sequence[Expr], prefix: str = "n") -> dict[Expr, str]:
        found = {}
        for i, node in enumerate(topological(outputs)):
            found[node] = node.value if node.op == "symbol" else f"{prefix}{i}"
        return found

    def lines(
        self, nodes: Sequence[Expr], varies: Mapping[Expr, bool], names: Mapping[Expr, str]
    ) -> tuple[list[str], list[str]]:
        """Lines before the loop, and inside."""
        before: list[str] = []
        inside: list[str] = []
        known = {(n.op, n.args): n for n in nodes}
        done: set[Expr] = set()
        for node in nodes:
            if node.op == "symbol" or node in done:
                continue
            lines = inside if varies[node] else before
            if node.op == "const":
                lines.append(f"{names[node]} = real({node.value!r}, dt)")
                continue
            own = [names[a] for a in node.args]
            if node.op in _PAIR:
                other = known.get((_PAIR[node.op == _PAIR[0]], node.args))
                if other is not None:
                    done.add(other)
                    pair = (node, other) if node.op == _PAIR[0] else (other, node)
                    left = ", ".join(names[n] for n in pair)
                    lines.append(f"{left} = torch_softplus({own[0]})")
                    continue
            lines.append(f"{names[node]} = {OPERATIONS[node.op].code.format(*own)}")
        return before, inside


def _indented(lines: Sequence[str], depth: int) -> str:
    return "".join(f"{'    ' * depth}{line}\n" for line in lines)
