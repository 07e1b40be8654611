"""Time and memory of a diagnosis of lanes in a process of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.synthetic_cases.platoons import DT, platoons, waves
from benchmarks.synthetic_cases.traffic.motion import Hidden

#: This checkout.
HERE = Path(__file__).parents[2]
#: Of the hidden law, v0 (m/s) and L (m), and the response to the speed ahead that its model lacks.
V0, LENGTH, KAPPA = 28.0, 6.0, 0.4
#: Seconds before the first sample.
BEFORE = 15.0
#: Is run with the package of any checkout, and uses only what old versions have as well.
_SCRIPT = """
import json, resource, sys, time
import numpy as np, torch
torch.set_num_threads(1)
from nnode.data.sequence import Sequence
from nnode.diagnosis.single_law import diagnose_law
from nnode.diagnosis.options import DiscoverOptions
from nnode.model.build import build_model
data, v0, length = np.load(sys.argv[1]), float(sys.argv[2]), float(sys.argv[3])
model = dict(term="lin", name="lin", leader="measured", v0=v0, L=length, L_min=1.0)
sequences = [
    Sequence(name=f"r/{i}", recording="r", time=time_, x=x[..., None])
    for i, (time_, x) in enumerate(zip(data["time"], data["x"]))
]
system = build_model(model)
wall, cpu = time.perf_counter(), time.process_time()
found = diagnose_law(system, sequences, DiscoverOptions()).diagnosis
print(json.dumps({
    "wall_s": time.perf_counter() - wall,
    "cpu_s": time.process_time() - cpu,
    "peak_memory_MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6,
    "verdict": found.verdict,
    "effects": [effect.name for effect in found.effects],
}))
"""


def environment(checkout: Path) -> dict[str, str]:
    """Of a process that uses a checkout's package with one thread."""
    return {**os.environ, "PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}


def data(number: int, vehicles: int, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Clock times ``(S, K)``, s, and positions ``(S, K, N)``, m."""
    rng = np.random.default_rng(0)
    speed = waves(rng, number, BEFORE + seconds, 17.0)
    hidden = Hidden(kappa_open=KAPPA, kappa_close=KAPPA)
    noise = {"push": 0.2, "correlation": 3.0, "error": 0.02}
    x = platoons(rng, speed, V0, LENGTH, hidden, vehicles=vehicles, before=BEFORE, **noise)
    return (seconds + 80) * np.arange(number)[:, None] + DT * np.arange(x.shape[1]), x


def diagnosed(
    sequences: int, checkout: Path = HERE, *, vehicles: int = 8, seconds: float = 30.0
) -> dict[str, Any]:
    """A diagnosis of platoons: wall time and CPU time, s, peak memory, MB, verdict and effects."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "platoons.npz"
        time, x = data(sequences, vehicles, seconds)
        np.savez(path, time=time, x=x)
        done = subprocess.run(
            [sys.executable, "-c", _SCRIPT, str(path), str(V0), str(LENGTH)],
            cwd=checkout,
            env=environment(checkout),
            capture_output=True,
            text=True,
            check=False,
        )
    if done.returncode:
        raise RuntimeError(f"the diagnosis by {checkout} failed:\n{done.stderr}")
    measured = json.loads(done.stdout.splitlines()[-1])
    return {"shape": "diagnosis", "sequences": sequences, "agents": vehicles, **measured}
