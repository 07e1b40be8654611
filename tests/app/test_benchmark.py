"""The benchmark: engines that agree are timed, others are refused."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from nnode.app import benchmark
from nnode.app.benchmark_engines import ENGINES
from nnode.app.benchmark_problems import SHAPES, Shape, pose
from nnode.config import BenchmarkConfig
from nnode.errors import ConfigError, SimulationError

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"


@pytest.fixture
def small(monkeypatch) -> None:  # type: ignore[no-untyped-def]
    tiny = (
        Shape("traffic", ("lin", "n4"), 3, 3, 2, 10, 0.02),
        Shape("crowd", ("sf", "nn"), 2, 4, 2, 1, 0.04),
    )
    monkeypatch.setitem(SHAPES, "paper", tiny)


def options(**changes: object):  # type: ignore[no-untyped-def]
    config = OmegaConf.structured(BenchmarkConfig)
    config.benchmark.update({"shapes": ["paper"], "repeats": 1, "restarts": 2, **changes})
    return config


def test_all_engines(small, tmp_path) -> None:  # type: ignore[no-untyped-def]
    chosen = ["odeint_adjoint", "odeint", "loop", "fused_1", "fused_2"]
    benchmark.benchmark(options(engines=chosen), tmp_path)
    found = json.loads((tmp_path / "benchmark.json").read_text())
    assert len(found["problems"]) == 4
    for problem in found["problems"]:
        assert list(problem["engines"]) == chosen
        for engine in problem["engines"].values():
            assert 0 < engine["min"] <= engine["median"] <= engine["max"]
            assert len(engine["all"]) == 1
    assert found["problems"][0]["ensemble"]["threads_1"]["single_runs"] > 0


def test_an_engine_that_is_wrong_is_refused(small, tmp_path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    right = ENGINES["loop"]

    def prepare(problem):  # type: ignore[no-untyped-def]
        call = right.prepare(problem)
        return lambda: (call()[0], 1.01 * call()[1])

    monkeypatch.setitem(ENGINES, "loop", replace(right, prepare=prepare))
    with pytest.raises(SimulationError, match="loop differs from the exact"):
        benchmark.benchmark(options(engines=["loop"]), tmp_path)
    assert not (tmp_path / "benchmark.json").exists()


@pytest.mark.parametrize("arrangement", ["scan", "scan_batch_last", "diffrax_batch_last"])
@pytest.mark.parametrize("law", ["lin", "log", "n4"])
def test_jax(law: str, arrangement: str) -> None:
    pytest.importorskip("jax")
    pytest.importorskip("diffrax")
    problem = pose(Shape("traffic", (law,), 3, 4, 3, 10, 0.02), law, torch.float32)
    states, gradient = ENGINES[arrangement].prepare(problem)()
    exact, wanted = ENGINES["odeint"].prepare(problem)()
    np.testing.assert_allclose(states, exact, rtol=1e-5)
    np.testing.assert_allclose(gradient, wanted, atol=2e-3 * np.abs(wanted).max())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shapes": ["huge"]}, "benchmark.shapes has huge, expected some of paper"),
        ({"engines": ["warp"]}, "benchmark.engines has warp"),
        ({"repeats": 0}, "benchmark.repeats=0"),
        ({"restarts": 0}, "benchmark.restarts=0"),
    ],
)
def test_refusals(changes, message, tmp_path) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ConfigError, match=message):
        benchmark.benchmark(options(**changes), tmp_path)


def test_script_refuses_unknown_options(tmp_path) -> None:  # type: ignore[no-untyped-def]
    done = subprocess.run(
        [sys.executable, str(SCRIPTS / "benchmark.py"), "benchmark.shape=[paper]"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=False,
    )
    assert done.returncode == 2
    assert "did you mean benchmark.shapes" in done.stderr
