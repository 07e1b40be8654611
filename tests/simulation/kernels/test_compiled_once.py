"""A law is compiled once per machine, and not in every process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

SCRIPT = """
import json
import numpy as np
from nnode.data.sequence import Sequence, collate
from nnode.model import Crowd, Traffic, make_law
from nnode.simulation import FusedSolver
from nnode.simulation.kernels import crowds, lanes, runs
x = {places} + {speed} * np.arange(3)[:, None, None]
batch = collate([Sequence(name="a", recording="a", time={dt} * np.arange(3), x=x)])
model = {model}
FusedSolver()(model, batch).x.sum().backward()
module = runs.compiled({source})
hits = [sum(f.stats.cache_hits.values()) for f in (module.forward, module.backward)]
print(json.dumps(hits))
"""
LANE = {
    "places": "np.cumsum(np.full((1, 4, 1), 12.0), 1)",
    "speed": 1.0,
    "dt": 0.2,
    "model": 'Traffic([make_law("network_speed")])',
    "source": "lanes.LaneSource(model.formula)",
}
CROWD = {
    "places": "np.arange(12.0).reshape(1, 6, 2)",
    "speed": 0.1,
    "dt": 0.04,
    "model": 'Crowd([make_law("relaxation"), make_law("social_force")])',
    "source": "crowds.CrowdSource(crowds.supports(model))",
}


@pytest.mark.thorough
@pytest.mark.parametrize("case", [LANE, CROWD], ids=["lane", "crowd"])
def test_second_process_does_not_compile(case: dict[str, Any], tmp_path: Path) -> None:
    runs = []
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT.format(**case)],
            env={**os.environ, "NNODE_CACHE": str(tmp_path)},
            capture_output=True,
            text=True,
            check=True,
        )
        runs.append(json.loads(done.stdout))
    assert runs == [[0, 0], [1, 1]]
    assert len(list((tmp_path / "fused").glob("*.py"))) == 1
