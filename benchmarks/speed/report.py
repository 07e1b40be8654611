"""Tables of the measured problems, one row per engine or size."""

from __future__ import annotations

from typing import Any

import pandas as pd

Rows = list[dict[str, Any]]


def show(title: str, rows: Rows) -> None:
    """Print a table, if there are rows."""
    if rows:
        table = pd.DataFrame(rows).to_string(index=False, float_format="{:.4g}".format, na_rep="")
        print(f"\n{title}\n{table}", flush=True)


def show_problem(row: dict[str, Any]) -> None:
    """Times of all engines on one problem, restarts, and the arithmetic alone."""
    engines, floor = row["engines"], row.get("floor")
    first = next(iter(engines.values()))["median"]
    fused = engines.get("fused_1", {}).get("median")
    table: Rows = []
    for name, taken in engines.items():
        line = {"engine": name, "ms": 1e3 * taken["median"]}
        line |= {"min": 1e3 * taken["min"], "max": 1e3 * taken["max"], "MB": taken["memory_MB"]}
        line["faster than the first"] = first / taken["median"]
        if fused:
            line["times fused_1"] = taken["median"] / fused
        for key in ("first_call", "gradient_error"):
            if key in taken:
                line[key] = taken[key]
        table.append(line | row.get("errors", {}).get(name, {}))
    show(f"{row['shape']}, {row['problem']}", table)
    if "warm_start" in row:
        print(f"first gradient of a new process, code in the cache: {row['warm_start']:.3g} s")
    if "starts" in row:
        print(f"first calls of new processes (s): {row['starts']}")
    if "ensemble" in row:
        runs = [row["ensemble"][f"threads_{n}"]["single_runs"] for n in (1, 2)]
        number = row["ensemble"]["restarts"]
        print(f"{number} restarts take {runs[0]:.3g} single runs, {runs[1]:.3g} with two threads")
    if floor and fused:
        print(
            f"{floor['evaluations']:,} softplus values and derivatives take "
            f"{1e3 * floor['median']:.3g} ms, fused_1 {fused / floor['median']:.3g} times as long"
        )


def per_person(problems: Rows) -> dict[str, dict[str, Any]]:
    """Seconds of one step of one person, and their ratio of the largest to the smallest.

    Args:
        problems: of the shape ``scale``.

    Returns:
        For every engine that solved all of them ``people``, ``seconds`` and ``ratio``; empty for
        fewer than two problems.
    """
    found = {}
    for engine in problems[0]["engines"] if len(problems) > 1 else ():
        if all(engine in row["engines"] for row in problems):
            seconds = [
                row["engines"][engine]["median"] / (row["agents"] * row["sequences"] * row["steps"])
                for row in problems
            ]
            people, ratio = [row["agents"] for row in problems], max(seconds) / min(seconds)
            found[engine] = {"people": people, "seconds": seconds, "ratio": ratio}
    return found
