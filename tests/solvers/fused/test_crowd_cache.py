"""Compiled crowd code is kept between processes, and not beyond a change of what it is made of."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from nnode.errors import ConfigError
from nnode.solvers.fused import crowd_cache

SCRIPT = """
import json
import numpy as np
from nnode.data.sequence import Sequence, collate
from nnode.models import Crowd, Relaxation, SocialForce
x = np.arange(12.0).reshape(1, 6, 2) + 0.1 * np.arange(3)[:, None, None]
batch = collate([Sequence(name="a", recording="a", time=0.04 * np.arange(3), x=x)])
model = Crowd([Relaxation(), SocialForce(1.0, 1.0, 1.0)])
from nnode.solvers import FusedSolver
FusedSolver()(model, batch).x.sum().backward()
from nnode.solvers.fused.crowd_cache import load
module = load("crowd_dense")
hits = [sum(f.stats.cache_hits.values()) for f in (module.forward, module.backward)]
print(json.dumps({"hits": hits}))
"""


@pytest.mark.thorough
def test_a_second_process_does_not_compile(tmp_path: Path) -> None:
    runs = []
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT],
            env={**os.environ, "NNODE_CACHE": str(tmp_path)},
            capture_output=True,
            text=True,
            check=True,
        )
        runs.append(json.loads(done.stdout))
    assert [run["hits"] for run in runs] == [[0, 0], [1, 1]]
    assert len(list((tmp_path / "fused").glob("*.py"))) == 1


def test_an_edit_changes_the_name(tmp_path: Path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    before = crowd_cache.digest(b"text")
    assert before == crowd_cache.digest(b"text") != crowd_cache.digest(b"other")
    for module in crowd_cache._COMPILED_IN:
        assert module.__file__ is not None
        file = tmp_path / Path(module.__file__).name
        file.write_bytes(Path(module.__file__).read_bytes() + b"\n# edited\n")
        with monkeypatch.context() as patch:
            patch.setattr(module, "__file__", str(file))
            assert crowd_cache.digest(b"text") != before


def test_everything_that_is_compiled_in_counts() -> None:
    # whatever a compiled file imports from the package must be part of the digest
    counted = {module.__name__ for module in crowd_cache._COMPILED_IN}
    names = [n.removeprefix("nnode.solvers.fused.") for n in counted if "fused" in n]
    folder = Path(crowd_cache.__file__).parent
    for name in ("crowd_dense", "crowd_sparse", *names):
        for line in (folder / f"{name}.py").read_text(encoding="utf-8").splitlines():
            if line.startswith("from nnode.") and "nnode.errors" not in line:
                assert line.split()[1] in counted, f"{name}: {line}"


def test_a_folder_that_cannot_be_written(tmp_path: Path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NNODE_CACHE", str(tmp_path / "file"))
    with pytest.raises(ConfigError, match="NNODE_CACHE"):
        crowd_cache.load.__wrapped__("crowd_dense")
