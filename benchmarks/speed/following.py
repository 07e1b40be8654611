"""Calibrating IDM to the training pairs: Gauss and Newton's method beside differential evolution.

Examples:
  python -m benchmarks.speed.following
  python -m benchmarks.speed.following --source FOLDER --laws idm gipps ovm

Both minimise the mean root mean square error of the gap over the same pairs within the published
bounds, in the same compiled simulator with one thread. Differential evolution is SciPy's with the
settings of the replication package (``studies/following/printed.yaml``).
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.optimize import differential_evolution

from nnode.calibrate.problem import ResidualProblem, pooled
from nnode.files import write_json
from studies.following import data, printed
from studies.following.tasks import EVERY, costs_of
from studies.options import FollowingStudyOptions


def timed(call: Callable[[], Any]) -> tuple[Any, dict[str, float]]:
    """What a call returns, and the seconds that it took: by the clock, and of the processor."""
    wall, cpu = time.perf_counter(), time.process_time()
    found = call()
    return found, {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}


def within_published(law: str, folder: str) -> ResidualProblem:
    """The cost on the training pairs with the published bounds; it starts in their middle."""
    cost = costs_of(EVERY[law], data.batch(folder))
    bounds = printed.bounds[law]
    for i, name in enumerate(cost.names):
        cost.low[i], cost.high[i] = bounds[name.split(".", 1)[1]]
    cost.start = (cost.low + cost.high) / 2
    return cost


def compare(law: str, folder: str) -> dict[str, Any]:
    """Costs and times of both, of the first call as well, which loads or compiles."""
    cost = within_published(law, folder)
    fit, cold = timed(lambda: pooled(cost))
    fit, warm = timed(lambda: pooled(cost))
    evolved, slow = timed(
        lambda: differential_evolution(
            lambda row: float(cost.costs(row).mean()),
            list(zip(cost.low, cost.high, strict=True)),
            **printed.evolution,
        )
    )
    return {
        "law": law,
        "pooled": {"cost": float(fit.cost), "simulations": fit.steps, "cold": cold, **warm},
        "evolution": {"cost": float(evolved.fun), "simulations": int(evolved.nfev), **slow},
        "above": float(fit.cost) / float(evolved.fun) - 1,
        "share_of_time": warm["cpu_s"] / slow["cpu_s"],
        "rows": {"pooled": np.round(fit.row, 4).tolist(), "evolution": evolved.x.tolist()},
    }


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--source", default=os.environ.get("NNODE_DATA"), help="raw files")
    parser.add_argument("--laws", nargs="+", default=["idm"], choices=list(printed.bounds))
    parser.add_argument("--out", type=Path, default=Path("runs/benchmark/following.json"))
    asked = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        options = FollowingStudyOptions(source=asked.source)
        where = str(data.stores(options, Path(folder))[data.PAIRS].folder)
        found = []
        for law in asked.laws:
            one = compare(law, where)
            found.append(one)
            for name in ("pooled", "evolution"):
                print(
                    f"{law} {name}: {one[name]['cost']:.5f} m, {one[name]['cpu_s']:.2f} s of the "
                    f"processor, {one[name]['wall_s']:.2f} s, {one[name]['simulations']} steps"
                )
            print(
                f"{law}: cost {100 * one['above']:+.3f} % above evolution's, "
                f"{100 * one['share_of_time']:.2f} % of its time; first call "
                f"{one['pooled']['cold']['wall_s']:.1f} s"
            )
    write_json(asked.out, {"laws": found})
    print(f"results: {asked.out}")


if __name__ == "__main__":
    main()
