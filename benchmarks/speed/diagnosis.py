"""How long a diagnosis of lanes takes, in this checkout and in another one, side by side.

Examples:
  python -m benchmarks.speed.diagnosis
  python -m benchmarks.speed.diagnosis --against /path/to/checkout --sequences 20 100 400

Both are given the same platoons, in which drivers react to the speed ahead and the model does not
know it, and each runs in a process of its own with one thread. Verdicts and named effects must be
the same, or the comparison says so.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from nnode.files import write_json

#: This checkout.
HERE = Path(__file__).parents[2]
#: Of the hidden law, v0 (m/s) and L (m), the reaction that its model lacks, and the standard
#: deviation (m/s) and the time (s) of the drivers' disturbances.
V0, LENGTH, KAPPA, PUSH, LASTS = 28.0, 6.0, 0.4, 0.2, 3.0
#: Vehicles of a platoon, its duration and sampling interval, s, and noise of positions, m.
VEHICLES, SECONDS, DT, NOISE = 5, 20.0, 0.2, 0.02
#: Steps in a sampling interval, and seconds before the first sample.
STEPS, BEFORE = 10, 15.0

#: Run with the other checkout's package: nothing but what both have may be used.
_SCRIPT = """
import json, resource, sys, time
import numpy as np, torch
torch.set_num_threads(1)
from nnode.data.sequence import Sequence
from nnode.discover.diagnose import diagnose
from nnode.discover.options import DiscoverOptions
from nnode.model.build import build_model
data, v0, length = np.load(sys.argv[1]), float(sys.argv[2]), float(sys.argv[3])
model = dict(term="lin", name="lin", leader="measured", v0=v0, L=length, L_min=1.0)
sequences = [
    Sequence(name=f"r/{i}", recording="r", time=time_, x=x[..., None])
    for i, (time_, x) in enumerate(zip(data["time"], data["x"]))
]
system = build_model(model)
wall, cpu = time.perf_counter(), time.process_time()
found = diagnose(system, sequences, DiscoverOptions()).diagnosis
print(json.dumps({
    "wall_s": time.perf_counter() - wall,
    "cpu_s": time.process_time() - cpu,
    "peak_memory_MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6,
    "verdict": found.verdict,
    "effects": [effect.name for effect in found.effects],
    "stages_s": found.seconds,
}))
"""


def platoons(
    number: int, seed: int = 0, vehicles: int = VEHICLES, seconds: float = SECONDS
) -> tuple[np.ndarray, np.ndarray]:
    """Clock times ``(S, K)``, s, and places ``(S, K, N)``, m, by Euler's method."""
    rng = np.random.default_rng(seed)
    step, samples = DT / STEPS, round(seconds / DT) + 1
    time = step * np.arange(round((seconds + BEFORE) / step) + 1)
    ends = ((0.8, 2.0), (8.0, 30.0), (0.0, 6.0))
    size, period, turn = (rng.uniform(low, high, (4, number)) for low, high in ends)
    angle = 2 * np.pi * time[:, None, None] / period + turn
    lead = 17 + (size * np.sin(angle)).sum(1)
    gap = LENGTH * V0 / (V0 - lead[0])
    x = gap[:, None] * np.arange(vehicles, dtype=float)
    push = PUSH * rng.normal(size=(number, vehicles - 1))
    keep, places = np.exp(-step / LASTS), []
    for ahead in lead:
        places.append(x.copy())
        speed = np.empty_like(x)
        speed[:, -1] = ahead
        law = V0 * (1 - LENGTH / np.diff(x, axis=1))
        for i in range(vehicles - 2, -1, -1):
            speed[:, i] = law[:, i] + KAPPA * (speed[:, i + 1] - law[:, i]) + push[:, i]
        x = x + step * speed
        push = keep * push + PUSH * np.sqrt(1 - keep**2) * rng.normal(size=push.shape)
    seen = np.array(places)[-(samples - 1) * STEPS - 1 :: STEPS].swapaxes(0, 1)
    clock = (seconds + 80) * np.arange(number)[:, None] + DT * np.arange(samples)
    return clock, seen + NOISE * rng.normal(size=seen.shape)


def diagnosis_of(data: Path, checkout: Path = HERE) -> dict[str, Any]:
    """What a checkout's diagnosis said, and what it took."""
    environment = {**os.environ, "PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", _SCRIPT, str(data), str(V0), str(LENGTH)],
        cwd=checkout,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(f"the diagnosis by {checkout} failed:\n{done.stderr}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def compared(sequences: int, other: Path | None, here: Path = HERE) -> dict[str, Any]:
    """One number of sequences: both checkouts, and how they compare."""
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "platoons.npz"
        time, x = platoons(sequences)
        np.savez(data, time=time, x=x)
        found: dict[str, Any] = {"sequences": sequences, "here": diagnosis_of(data, here)}
        if other is not None:
            found["other"] = diagnosis_of(data, other)
            found["same"] = all(
                found["here"][key] == found["other"][key] for key in ("verdict", "effects")
            )
            found["ratios"] = {
                key: found["here"][key] / found["other"][key]
                for key in ("wall_s", "cpu_s", "peak_memory_MB")
            }
    return found


def _print(found: dict[str, Any]) -> None:
    print(f"{found['sequences']} sequences", flush=True)
    for name in ("other", "here"):
        if name in found:
            one = found[name]
            print(
                f"  {name:6} {one['wall_s']:8.1f} s  CPU {one['cpu_s']:8.1f} s  "
                f"{one['peak_memory_MB']:7.0f} MB  {one['verdict']}: {', '.join(one['effects'])}"
            )
    if "ratios" in found:
        said = "the same verdict and effects" if found["same"] else "ANOTHER VERDICT OR EFFECT"
        wall, cpu, memory = found["ratios"].values()
        print(f"  ratio  {wall:8.2f}    CPU {cpu:8.2f}    {memory:7.2f}     {said}", flush=True)


def main(arguments: list[str] | None = None) -> int:
    """Returns 1 where verdicts or effects differ."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0] if __doc__ else "")
    parser.add_argument("--against", type=Path, help="another checkout, such as one of before")
    parser.add_argument("--sequences", type=int, nargs="+", default=[20, 100])
    parser.add_argument("--json", type=Path, help="where the numbers are written")
    given = parser.parse_args(arguments)
    other = None if given.against is None else given.against.resolve()
    found: list[dict[str, Any]] = []
    for number in given.sequences:
        found.append(compared(number, other))
        _print(found[-1])
        if given.json is not None:
            write_json(given.json, {"compared": found})
    return int(not all(one.get("same", True) for one in found))


if __name__ == "__main__":
    sys.exit(main())
