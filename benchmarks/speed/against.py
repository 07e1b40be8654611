"""This checkout and another one: ``python -m benchmarks.speed.against --against CHECKOUT``.

Compiled code: each checkout has a process of its own that waits for its turn, so that other load
hits both equally. CPU time on one thread is compared, and the results must be the same up to
rounding. ``--cases diagnosis_N``: a diagnosis of N platoons of 5 vehicles over 20 s; verdicts and
effects must be the same.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.speed.diagnosis import HERE, diagnosed, environment

#: What is timed: shape, model, and a gradient, or tangents and states alone.
CASES = {
    "sf": ("crowd", "sf", "gradient"),
    "nn": ("crowd", "nn", "gradient"),
    "hall": ("scale", "sf", "gradient"),
    "n4": ("stress", "n4", "gradient"),
    "sf+1": ("crowd_effects", "sf+1", "gradient"),
    "lin_places": ("tangents", "lin_places", "tangents"),
    "idm_zone": ("tangents", "idm_zone", "tangents"),
    "lin_ahead": ("tangents", "lin_ahead", "tangents"),
}
#: Prefix of the cases that are diagnoses.
_DIAGNOSIS = "diagnosis_"
#: Answers each line with CPU seconds, and first with two numbers that must agree.
_SCRIPT = """
import sys, time
import torch
from benchmarks.speed.engines import torch_call
from benchmarks.speed.problems import SHAPES, pose
from nnode.simulation import FusedSolver
torch.set_num_threads(1)
name, model, what = sys.argv[1:]
shape = next(one for one in SHAPES[name] if model in one.models)
problem = pose(shape, model, torch.float32)
if what == "gradient":
    calls = {what: torch_call(problem, FusedSolver(shape.step))}
else:
    from benchmarks.speed.tangents import calls as tangent_calls
    calls = tangent_calls(problem)
found = {key: call() for key, call in calls.items()}
last = found[what]
pair = last if isinstance(last, tuple) else (found["forward"].numpy(), last.numpy())
print(*(abs(one.astype(float)).sum() for one in pair), flush=True)
for line in sys.stdin:
    begin = time.process_time()
    for _ in range(int(line.split()[1])):
        calls[line.split()[0]]()
    print(time.process_time() - begin, flush=True)
"""


class Worker:
    """A process of one checkout."""

    def __init__(self, checkout: Path, case: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", _SCRIPT, *CASES[case]],
            cwd=checkout,
            env=environment(checkout),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.results = [float(number) for number in self._read().split()]

    def _read(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError("a checkout cannot pose this problem, see the error above")
        return line

    def seconds(self, what: str, times: int) -> float:
        """CPU time of a call."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{what} {times}\n")
        self._process.stdin.flush()
        return float(self._read()) / times

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def compared(case: str, other: Path, rounds: int) -> dict[str, Any]:
    """One problem by both checkouts: times, and medians of their ratios."""
    if case.startswith(_DIAGNOSIS):
        number = int(case.removeprefix(_DIAGNOSIS))
        pair = [diagnosed(number, checkout, vehicles=5, seconds=20.0) for checkout in (HERE, other)]
        keys = ("wall_s", "cpu_s", "peak_memory_MB")
        same = all(pair[0][key] == pair[1][key] for key in ("verdict", "effects"))
        ratios = {f"{key} here / other": pair[0][key] / pair[1][key] for key in keys}
        return {"case": case, "here": pair[0], "other": pair[1], "same": same, **ratios}
    workers = {"here": Worker(HERE, case), "other": Worker(other, case)}
    what = ["forward", "tangents"] if CASES[case][2] == "tangents" else ["gradient"]
    taken: dict[str, list[float]] = {f"{name} {key}": [] for name in workers for key in what}
    for key in what:
        times = max(1, round(0.2 / max(1e-4, workers["here"].seconds(key, 1))))
        for _ in range(rounds):
            for name, worker in workers.items():
                taken[f"{name} {key}"].append(worker.seconds(key, times))
    for worker in workers.values():
        worker.close()

    def ratio(a: str, b: str) -> float:
        return median(x / y for x, y in zip(taken[a], taken[b], strict=True))

    row: dict[str, Any] = {"case": case, **{k: median(v) for k, v in taken.items()}}
    pairs = zip(workers["here"].results, workers["other"].results, strict=True)
    row["difference"] = max(abs(a - b) / abs(b) for a, b in pairs)
    row |= {f"{key} here / other": ratio(f"here {key}", f"other {key}") for key in what}
    if len(what) > 1:
        for name in workers:
            row[f"{name}: tangents / forward"] = ratio(f"{name} tangents", f"{name} forward")
    return row


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--against", type=Path, required=True, help="another checkout")
    names = f"{', '.join(CASES)}, {_DIAGNOSIS}20, ..."
    parser.add_argument("--cases", nargs="+", default=list(CASES), help=names)
    parser.add_argument("--rounds", type=int, default=15)
    given = parser.parse_args(arguments)
    for case in given.cases:
        print(json.dumps(compared(case, given.against.resolve(), given.rounds)), flush=True)


if __name__ == "__main__":
    main()
