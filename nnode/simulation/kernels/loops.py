"""Loops over rows of numbers, as source text for Numba.

Expressions that do not vary along a row are computed once before the loop. The gradient by them is
computed after the loop, from sums over the loop.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from nnode.model.differentiate import vjp
from nnode.model.expression import Expr, const, symbol, symbols, topological
from nnode.model.operations import OPERATIONS


@dataclass(frozen=True)
class Loop:
    """Generator of loops.

    Attributes:
        uniform: symbols with one value along a row, in the order of the array ``q``.
        scalars: further such symbols, which are arguments of the function.
        options: name of the compiler's options in the module.
        fixed: uniform symbols without a gradient.
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
        """Source of a function ``name(buffer, lo, n, q, t, dt, drives, total)`` for rows.

        Args:
            rows: row to the formula that is stored there.
            sums: label to a formula whose sum over the loop is the variable ``sum_label``.
            after: lines after the loop.
        """
        sums = sums or {}
        outputs = [*rows.values(), *sums.values()]
        varies, names = self.varies(outputs), self._names(outputs)
        lines = self._lines(names)
        inside = [
            "k = np.uint64(lo) + j",
            *(
                f"{n.value} = buffer[k + _{n.value}]"
                for n in names
                if n.op == "symbol" and varies[n]
            ),
            *(line for n, line in lines.items() if varies[n]),
            *(f"buffer[k + _{row}] = {names[n]}" for row, n in rows.items()),
            *(f"sum_{s} = add(sum_{s}, {names[n]})" for s, n in sums.items()),
        ]
        body = [
            "zero = real(0, dt)",
            *self._given(outputs),
            *(line for n, line in lines.items() if not varies[n]),
            *(f"sum_{label} = zero" for label in sums),
            "for j in range(np.uint64(n)):",
            *(f"    {line}" for line in inside),
            *after,
        ]
        head = f"\n\n@njit(**{self.options})\ndef {name}(buffer, lo, n, q, t, dt, drives, total):\n"
        return head + "".join(f"    {line}\n" for line in body)

    def statements(self, outputs: Sequence[Expr], prefix: str = "n") -> tuple[list[str], list[str]]:
        """Lines that evaluate formulas of scalars, and the names of their values."""
        names = self._names(outputs, prefix)
        lines = [*self._given(outputs), *self._lines(names).values()]
        return lines, [names[node] for node in outputs]

    def vjp(
        self, name: str, outputs: Mapping[str, Expr], rows: Mapping[str, str], onto: Iterable[str]
    ) -> str:
        """Source of a function that adds the gradient by uniform quantities to ``total``, and
        stores adjoints of others in rows.

        Args:
            outputs: row of an output's weight to the output.
            rows: row to the symbol whose adjoint is stored there.
            onto: rows to whose content the adjoint is added.
        """
        stored, ends = self.adjoints(outputs, rows)
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
        # expressions of the gradient by uniform quantities are computed after the loop
        lines, results = self.statements([*gradient.values()], "u")
        totals = [
            f"total[{self.uniform.index(p)}] += {result}"
            for p, result in zip(gradient, results, strict=True)
        ]
        return self.function(name, stored, sums, [*lines, *totals])

    def adjoints(
        self, outputs: Mapping[str, Expr], rows: Mapping[str, str]
    ) -> tuple[dict[str, Expr], dict[Expr, Expr]]:
        """Row to the stored adjoint, and uniform node to the adjoint that is summed over the
        loop; see :meth:`vjp`."""
        seeds: dict[Expr, Expr] = {}
        for weight, node in outputs.items():
            if not node.is_number():  # numbers have no gradient
                seeds[node] = seeds.get(node, const(0)) + symbol(weight)
        varies = self.varies([*seeds, *seeds.values()])
        bar = vjp(seeds, lambda node: not varies[node])
        stored = {row: bar.get(symbol(quantity), const(0)) for row, quantity in rows.items()}
        still = {*self.fixed, *self.scalars}
        ends = {n: b for n, b in bar.items() if not varies[n] and not set(symbols([n])) <= still}
        return stored, ends

    def _given(self, outputs: Iterable[Expr]) -> list[str]:
        """Lines that assign the uniform quantities in formulas."""
        needed = set(symbols(outputs))
        return [f"{p} = q[{j}]" for j, p in enumerate(self.uniform) if p in needed]

    def _names(self, outputs: Iterable[Expr], prefix: str = "n") -> dict[Expr, str]:
        """Node to its name in code, each after its arguments."""
        nodes = enumerate(topological(outputs))
        return {n: n.value if n.op == "symbol" else f"{prefix}{i}" for i, n in nodes}

    def _lines(self, names: Mapping[Expr, str]) -> dict[Expr, str]:
        """Node to the line that computes it."""
        lines = {}
        for node, name in names.items():
            if node.op == "const":
                lines[node] = f"{name} = real({node.value!r}, dt)"
            elif node.op != "symbol":
                code = OPERATIONS[node.op].code.format(*(names[a] for a in node.args))
                lines[node] = f"{name} = {code}"
        return lines
