"""What the benchmark prints."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table

WIDTH = 120


def print_problem(row: dict[str, Any]) -> None:
    """The times of all engines on one problem, what restarts cost, and the arithmetic alone."""
    table = Table(title=f"{row['shape']}, {row['problem']}")
    engines = row["engines"]
    heads = (
        "engine",
        "median (ms)",
        "min … max (ms)",
        "first call (s)",
        "memory (MB)",
        "gradient error",
    )
    fused = engines.get("fused_1")
    for head in (*heads, *(("times fused_1",) if fused else ())):
        table.add_column(head, justify="left" if head == "engine" else "right")
    for name, engine in engines.items():
        memory = engine["memory_MB"]
        cells = [
            name,
            f"{1e3 * engine['median']:.4g}",
            f"{1e3 * engine['min']:.4g} … {1e3 * engine['max']:.4g}",
            f"{engine['first_call']:.3g}",
            "?" if memory is None else f"{memory:.0f}",
            f"{engine['gradient_error']:.1e}",
        ]
        if fused:
            cells.append(f"{engine['median'] / fused['median']:.3g}")
        table.add_row(*cells)
    console = Console(width=WIDTH)
    console.print(table)
    ensemble, floor = row.get("ensemble"), row.get("floor")
    if ensemble:
        parts = [
            f"{ensemble[f'threads_{n}']['single_runs']:.3g} single runs with {n} thread(s)"
            for n in (1, 2)
        ]
        console.print(f"{ensemble['restarts']} restarts cost {', '.join(parts)}")
    if "warm_start" in row:
        console.print(f"first gradient of a new process, kept code: {row['warm_start']:.3g} s")
    if floor:
        line = (
            f"arithmetic alone: {floor['evaluations']:,} softplus values and derivatives take "
            f"{1e3 * floor['median']:.3g} ms"
        )
        if fused:
            line += f", fused_1 takes {fused['median'] / floor['median']:.3g} times as long"
        console.print(line)


def print_tangents(rows: list[dict[str, Any]]) -> None:
    """What derivatives by all parameters cost beside the simulation alone."""
    if not rows:
        return
    table = Table(title="states alone, and with their exact derivatives by all parameters")
    heads = ("forward (ms)", "tangents (ms)", "times", "runs of quotients", "cold (s)", "warm (s)")
    table.add_column("problem")
    for head in heads:
        table.add_column(head, justify="right")
    for row in rows:
        alone, both, starts = (*(row["engines"][k] for k in ("forward", "tangents")), row["starts"])
        first = {
            at: " / ".join(f"{starts[k][at]:.3g}" for k in ("forward", "tangents"))
            for at in ("cold", "warm")
        }
        table.add_row(
            row["problem"],
            f"{1e3 * alone['median']:.4g}",
            f"{1e3 * both['median']:.4g}",
            f"{both['median'] / alone['median']:.3g}",
            str(1 + row["parameters"]),
            first["cold"],
            first["warm"],
        )
    Console(width=WIDTH).print(table)


def per_person(problems: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """How the cost of one person changes from the smallest to the largest crowd.

    Args:
        problems: timed ones of the shape ``scale``.

    Returns:
        For every engine that solved all of them: ``people``; ``seconds``, of one step of one
        person in one gradient; ``ratio``, largest to smallest of these. Empty for fewer than
        two problems.
    """
    if len(problems) < 2:
        return {}
    found = {}
    for engine in problems[0]["engines"]:
        if not all(engine in row["engines"] for row in problems):
            continue
        seconds = [
            row["engines"][engine]["median"] / (row["agents"] * row["sequences"] * row["steps"])
            for row in problems
        ]
        found[engine] = {
            "people": [row["agents"] for row in problems],
            "seconds": seconds,
            "ratio": max(seconds) / min(seconds),
        }
    return found


def print_per_person(found: dict[str, dict[str, Any]]) -> None:
    """The result of :func:`per_person`."""
    for engine, row in found.items():
        times = ", ".join(f"{1e6 * s:.3g}" for s in row["seconds"])
        sizes = ", ".join(map(str, row["people"]))
        Console(width=WIDTH).print(
            f"{engine}: one step of one person takes {times} µs among {sizes} people; "
            f"largest / smallest {row['ratio']:.3g}"
        )


def print_methods(rows: list[dict[str, Any]]) -> None:
    """Times and errors of problems of the shape ``methods``."""
    for row in rows:
        table = Table(title=f"one gradient by method, {row['problem']}")
        table.add_column("method, step")
        heads = ("median (ms)", "faster than the first", "rms (m)", "largest (m)", "gradient")
        for head in heads:
            table.add_column(head, justify="right")
        engines = row["engines"]
        first = next(iter(engines.values()))["median"]
        for name, taken in engines.items():
            away = row["errors"][name]
            table.add_row(
                name,
                f"{1e3 * taken['median']:.4g}",
                f"{first / taken['median']:.3g}",
                *(f"{away[key]:.1e}" for key in ("rms", "largest", "gradient")),
            )
        Console(width=WIDTH).print(table)
