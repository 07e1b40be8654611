"""The benchmark of solvers: matching engines are timed, others are refused."""

from __future__ import annotations

import json
import platform
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from omegaconf import OmegaConf

from benchmarks.config import BenchmarkConfig
from benchmarks.speed import floor
from benchmarks.speed.engines import ENGINES
from benchmarks.speed.memory import peak_memory
from benchmarks.speed.problems import SHAPES, Shape, pose
from benchmarks.speed.run import benchmark
from nnode.errors import ConfigError, SimulationError
from tests.simulation.kernels.test_lane_code import PACKED, is_vector_code


@pytest.fixture
def small(monkeypatch) -> None:
    tiny = (
        Shape("traffic", ("lin", "n4"), 3, 3, 2, 10, 0.02),
        Shape("crowd", ("sf", "nn"), 2, 4, 2, 1, 0.04),
    )
    monkeypatch.setitem(SHAPES, "paper", tiny)


def options(**changes: object):
    config = OmegaConf.structured(BenchmarkConfig)
    config.benchmark.update({"shapes": ["paper"], "repeats": 1, "restarts": 2, **changes})
    return config


def measured(folder: Path) -> pd.DataFrame:
    """The rows of a run."""
    return pd.DataFrame(json.loads((folder / "benchmark.json").read_text())["rows"])


@pytest.mark.thorough
def test_all_engines_are_timed(small, tmp_path) -> None:
    engines = ["odeint_adjoint", "odeint", "loop", "fused_1", "fused_2"]
    benchmark(options(engines=engines), tmp_path)
    rows = measured(tmp_path)
    assert list(rows["model"].unique()) == ["lin", "n4", "sf", "nn"]
    assert (rows[["min", "median", "max"]].diff(axis=1).iloc[:, 1:] >= 0).all(axis=None)
    for model, part in rows.groupby("model"):
        restarts = ["restarts_1", "restarts_2"] if model in ("lin", "n4") else []
        floor = ["floor"] if model == "n4" else []
        assert list(part["engine"]) == [*engines, *restarts, *floor]
    # softplus of 4 neurons for 2 followers in 3 sequences and 20 steps
    assert rows["evaluations"].dropna().tolist() == [4 * 2 * 3 * 20]
    np.testing.assert_allclose(rows.loc[rows["engine"] == "fused_1", "times fused_1"], 1.0)
    assert not (tmp_path / "benchmark.png").exists()  # a single number of steps and of people


@pytest.fixture
def series(monkeypatch) -> None:
    steps = tuple(Shape("traffic", ("n4",), 2, 3, n, 5, 0.02) for n in (1, 2))
    # enough people and time for encounters: a gradient of zero has no relative error
    people = tuple(Shape("crowd", ("sf",), 1, n, 25, 1, 0.04) for n in (50, 100))
    for name, shapes in (("steps", steps), ("scale", people)):
        monkeypatch.setitem(SHAPES, name, shapes)


@pytest.mark.thorough
@pytest.mark.parametrize("engine", ["loop", "fused_1"])
def test_series_is_plotted(engine, series, tmp_path) -> None:
    benchmark(options(shapes=["steps", "scale"], engines=["odeint", engine]), tmp_path)
    rows = measured(tmp_path)
    scale = rows[(rows["engine"] == engine) & (rows["shape"] == "scale")]
    assert list(scale["agents"]) == [50, 100]
    np.testing.assert_allclose(scale["µs"], 1e6 * scale["median"] / [1250, 2500])
    figure = (tmp_path / "benchmark.png").read_bytes()
    redrawn = tmp_path / "redrawn"
    benchmark(options(redraw=str(tmp_path / "benchmark.json")), redrawn)
    assert (redrawn / "benchmark.png").read_bytes() == figure
    assert not (redrawn / "benchmark.json").exists()


def test_odeint_covers_all_but_the_largest_crowds() -> None:
    covers = {
        (name, shape.agents): ENGINES["odeint"].covers(pose(shape, shape.models[0], torch.float32))
        for name, shapes in SHAPES.items()
        for shape in shapes
    }
    assert {key for key, covered in covers.items() if not covered} == {
        ("scale", people) for people in (1000, 2000, 5000, 10000)
    }


def test_memory_of_a_call() -> None:
    def call(megabytes: int) -> int:
        return len(np.ones(megabytes * 125_000))

    peak_memory(lambda: call(300))
    result, memory = peak_memory(lambda: call(100))
    assert result == 12_500_000
    if memory["peak_memory_MB"] is None or memory["memory_MB"] is None:
        pytest.skip("the system does not report memory")
    assert memory["memory_MB"] == pytest.approx(100, abs=10)
    assert memory["peak_memory_MB"] > 100


def test_floor_is_the_arithmetic_of_a_network() -> None:
    (stress,) = SHAPES["stress"]
    # 9 followers in 100 sequences, 4 neurons, 5000 steps
    assert floor.evaluations(pose(stress, "n4", torch.float32)) == 18_000_000
    assert floor.floor_call(pose(stress, "lin", torch.float32)) is None
    x = np.linspace(-9, 9, 64)
    result = x.copy()
    floor.rows(result, 2)
    for _ in range(2):
        x = np.log1p(np.exp(x)) - 1 / (1 + np.exp(-x))
    np.testing.assert_allclose(result, x, rtol=1e-13)


@pytest.mark.skipif(platform.machine() not in PACKED, reason="unknown instruction set")
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_floor_is_vector_code(kind: type) -> None:
    # a scalar loop would be ten times slower than the true lower limit
    x = np.ones(64, kind)
    floor.rows(x, 1)
    (text,) = (
        floor.rows.inspect_asm(s)
        for s in floor.rows.signatures
        if s[0].dtype.name == np.dtype(kind).name
    )
    assert is_vector_code(text, loops=1)


def test_inaccurate_engine_is_refused(small, tmp_path, monkeypatch) -> None:
    accurate = ENGINES["loop"]

    def prepare(problem):
        call = accurate.prepare(problem)
        return lambda: (call()[0], 1.01 * call()[1])

    monkeypatch.setitem(ENGINES, "loop", replace(accurate, prepare=prepare))
    with pytest.raises(SimulationError, match="loop differs from the exact"):
        benchmark(options(engines=["loop"]), tmp_path)
    assert not (tmp_path / "benchmark.json").exists()


@pytest.mark.parametrize("arrangement", ["scan", "scan_batch_last", "diffrax_batch_last"])
@pytest.mark.parametrize("law", ["lin", "log", "n4"])
def test_jax_engines(law: str, arrangement: str) -> None:
    pytest.importorskip("jax")
    pytest.importorskip("diffrax")
    problem = pose(Shape("traffic", (law,), 3, 4, 3, 10, 0.02), law, torch.float32)
    states, gradient = ENGINES[arrangement].prepare(problem)()
    exact, expected = ENGINES["odeint"].prepare(problem)()
    np.testing.assert_allclose(states, exact, rtol=1e-5)
    np.testing.assert_allclose(gradient, expected, atol=2e-3 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("changes", "results", "message"),
    [
        ({"shapes": ["huge"]}, "", "benchmark.shapes has huge, expected some of paper"),
        ({"engines": ["warp"]}, "", "benchmark.engines has warp"),
        ({"repeats": 0}, "", "benchmark.repeats=0"),
        ({"restarts": 0}, "", "benchmark.restarts=0"),
        ({"sequences": [20, 0]}, "", "benchmark.sequences"),
        # unreadable results
        ({"redraw": "none.json"}, "", "cannot be read.*FileNotFoundError"),
        ({"redraw": "a.json"}, "{", "cannot be read.*expected the benchmark.json of an earlier"),
        ({"redraw": "a.json"}, '{"problems": 3}', "cannot be read.*rows"),
        ({"redraw": "a.json"}, '{"rows": []}', "has nothing to draw; expected at least two"),
    ],
)
def test_invalid_options_are_refused(
    changes: dict[str, object], results: str, message: str, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("a.json").write_text(results)
    with pytest.raises(ConfigError, match=message):
        benchmark(options(**changes), tmp_path)


@pytest.mark.thorough  # compiles three methods
def test_methods_are_timed_with_their_errors(tmp_path, monkeypatch, capsys) -> None:
    (shape,) = SHAPES["methods"]
    tiny = replace(shape, models=("idm",), sequences=2, agents=3, samples=20)
    monkeypatch.setitem(SHAPES, "methods", (tiny,))
    benchmark(options(shapes=["methods"]), tmp_path)
    error = measured(tmp_path).set_index("engine")["gradient"]
    assert 0 < error["rk4 0.1 s"] < error["euler 0.002 s"] < error["ballistic 0.1 s"]
    assert "idm: 2 sequences, 3 cars" in capsys.readouterr().out
