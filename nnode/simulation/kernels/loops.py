"""Loops over rows of numbers, as source text for Numba.

What does not vary along a row is computed once before the loop; the gradient by it is computed from
sums over the loop, after the loop.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from nnode.model.differentiate import vjp
from nnode.model.expression import Expr, const, symbol, symbols, topological
from nnode.model.operations import OPERATIONS


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
        varying: dict[Expr, bool] = {}
        for node in topological(nodes):
            uneven = node.op == "symbol" and node.value not in same
            varying[node] = uneven or any(varying[a] for a in node.args)
        return varying

    def function(
        self,
        name: str,
        rows: Mapping[str, Expr],
        sums: Mapping[str, Expr] | None = None,
        after: Sequence[str] = (),
    ) -> str:
        """A function ``name(buffer, lo, n, q, t, dt, drives, total)`` that computes rows.

        Args:
            rows: row to what is stored there.
            sums: label to what is summed over the loop, in ``sum_label``.
            after: lines after the loop.
        """
        sums = sums or {}
        outputs = [*rows.values(), *sums.values()]
        varies, names = self.varies(outputs), self.names(outputs)
        lines = self.lines(names)
        read = [n.value for n in names if n.op == "symbol" and varies[n]]
        inside = [
            "k = np.uint64(lo) + j",
            *(f"{row} = buffer[k + _{row}]" for row in read),
            *(line for n, line in lines.items() if varies[n]),
            *(f"buffer[k + _{row}] = {names[n]}" for row, n in rows.items()),
            *(f"sum_{s} = add(sum_{s}, {names[n]})" for s, n in sums.items()),
        ]
        body = [
            "zero = real(0, dt)",
            *self.given(outputs),
            *(line for n, line in lines.items() if not varies[n]),
            *(f"sum_{label} = zero" for label in sums),
            "for j in range(np.uint64(n)):",
            *(f"    {line}" for line in inside),
            *after,
        ]
        head = f"\n\n@njit(**{self.options})\ndef {name}(buffer, lo, n, q, t, dt, drives, total):\n"
        return head + "".join(f"    {line}\n" for line in body)

    def given(self, outputs: Iterable[Expr]) -> list[str]:
        """Lines that name the uniform quantities that formulas need."""
        needed = set(symbols(outputs))
        return [f"{p} = q[{j}]" for j, p in enumerate(self.uniform) if p in needed]

    def vjp(
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
        adjoints = vjp(
            {node: symbol(f"sum_{i}") for i, node in enumerate(ends)}, lambda node: False
        )
        gradient = {
            n.value: b
            for n, b in adjoints.items()
            if n.value in self.uniform and n.value not in self.fixed
        }
        # what the chain behind the loop needs is computed there
        names = self.names(gradient.values(), "u")
        after = [*self.given(gradient.values()), *self.lines(names).values()]
        after += [f"total[{self.uniform.index(p)}] += {names[b]}" for p, b in gradient.items()]
        return self.function(name, stored, sums, after)

    def adjoints(
        self, seeds: Mapping[Expr, Expr], rows: Mapping[str, str]
    ) -> tuple[dict[str, Expr], dict[Expr, Expr]]:
        """What is stored in rows, and what is summed over the loop of every node that does not
        vary in it."""
        varies = self.varies([*seeds, *seeds.values()])
        bar = vjp(seeds, lambda node: not varies[node])
        stored = {row: bar.get(symbol(quantity), const(0)) for row, quantity in rows.items()}
        still = {*self.fixed, *self.scalars}
        ends = {n: b for n, b in bar.items() if not varies[n] and not set(symbols([n])) <= still}
        return stored, ends

    def of_numbers(self, name: str, formula: Expr) -> list[str]:
        """Lines that compute a formula of numbers and give it a name."""
        names = self.names([formula])
        return [*self.lines(names).values(), f"{name} = {names[formula]}"]

    def names(self, outputs: Iterable[Expr], prefix: str = "n") -> dict[Expr, str]:
        """Names of nodes in code, each after what it is made of."""
        nodes = enumerate(topological(outputs))
        return {n: n.value if n.op == "symbol" else f"{prefix}{i}" for i, n in nodes}

    def lines(self, names: Mapping[Expr, str]) -> dict[Expr, str]:
        """Lines that compute nodes."""
        lines = {}
        for node, name in names.items():
            if node.op == "const":
                lines[node] = f"{name} = real({node.value!r}, dt)"
            elif node.op != "symbol":
                code = OPERATIONS[node.op].code.format(*(names[a] for a in node.args))
                lines[node] = f"{name} = {code}"
        return lines
