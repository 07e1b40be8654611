"""Compiled code: vector instructions, laws from elsewhere, and what is kept between processes."""

from __future__ import annotations

import platform
import re
from pathlib import Path

import numba
import numpy as np
import pytest
import torch

from nnode.errors import ConfigError
from nnode.model import Crowd, Traffic, make_law
from nnode.model.effects.lane import RelativeSpeed
from nnode.simulation import FusedSolver
from nnode.simulation.kernels import functions, lanes, source
from nnode.simulation.kernels.cache import digest
from nnode.simulation.kernels.lanes import LaneSource
from nnode.simulation.kernels.runs import COMPILED_IN
from tests.builders import social_forces
from tests.simulation.fused.compare import gradient, single

#: Divisions of several numbers at once, by processor.
PACKED = {
    "x86_64": r"\sv?divp[sd]\s",
    "AMD64": r"\sv?divp[sd]\s",
    "aarch64": r"\sfdiv(\.[24][sd])?\s+v",
    "arm64": r"\sfdiv(\.[24][sd])?\s+v",
}
#: Calls into the mathematical library, which stay scalar.
LIBRARY = r"\b(call\w*|movabsq|bl|adrp)\s[^\n]*\b(exp2?|expm1|log1p|log2?|pow)f?\b"
#: Calls of our own functions that were not inlined.
CALLED = r"\b(call\w*|movabsq|bl)\s[^\n]*\b_ZN5nnode8simulate\w*functions"


def is_vector_code(text: str, loops: int = 1) -> bool:
    """Whether assembly divides several numbers at once, in so many places, and calls nothing."""
    packed = len(re.findall(PACKED[platform.machine()], text)) >= loops
    return packed and not re.search(LIBRARY, text) and not re.search(CALLED, text)


@pytest.fixture
def fresh(tmp_path, monkeypatch) -> Path:  # type: ignore[no-untyped-def]
    """An empty cache, and modules loaded from it."""
    monkeypatch.setenv("NNODE_CACHE", str(tmp_path))
    monkeypatch.setattr(lanes, "compiled", lanes.compiled.__wrapped__)
    return Path(tmp_path)


@pytest.mark.thorough
@pytest.mark.skipif(platform.machine() not in PACKED, reason="unknown instruction set")
@pytest.mark.parametrize(
    ("law", "dtype"),
    [
        ("network_speed", torch.float64),
        ("log", torch.float32),
        ("network_speed", torch.float32),
        ("log", torch.float64),
        ("lin", torch.float64),
        ("lin", torch.float32),
    ],
)
def test_loops_are_vector_code(law, dtype, ragged, fresh, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    # losing this makes everything ten times slower and nothing else would tell
    modules = []
    load = lanes.compiled

    def remember(own: LaneSource) -> object:
        modules.append(load(own))
        return modules[-1]

    monkeypatch.setattr(lanes, "compiled", remember)
    batch = single(ragged).to(dtype=dtype)
    gradient(Traffic([make_law(law)]).to(dtype), FusedSolver(0.1), batch)
    # every law divides in its derivatives
    function = modules[-1].backward
    (signature,) = function.signatures
    assert is_vector_code(function.inspect_asm(signature))


@pytest.mark.skipif(platform.machine() not in PACKED, reason="unknown instruction set")
@pytest.mark.parametrize("body", ["np.exp(-x[i])", "np.log(x[i] + 2)", "far(x[i])", "exp(-x[i])"])
def test_the_guard_sees_scalar_code(body: str) -> None:
    @numba.njit(error_model="numpy", inline="never")
    def far(x: float) -> float:
        return np.exp(-x)  # type: ignore[no-any-return]

    names = {"np": np, "far": far, "exp": functions.exp}
    text = f"""
def run(x, out):
    for i in range(len(x)):
        out[i] = x[i] / (1 + {body})
    for i in range(len(x)):
        out[i] = x[i] / (3 + out[i])
"""
    exec(text, names)
    run = numba.njit(error_model="numpy", fastmath=functions.FLAGS)(names["run"])
    run(np.ones(4), np.ones(4))
    assert is_vector_code(run.inspect_asm(run.signatures[0])) == (body == "exp(-x[i])")


def test_an_edit_of_what_is_compiled_in_changes_the_name(tmp_path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    before = digest(b"text", COMPILED_IN)
    assert digest(b"other", COMPILED_IN) != before
    for module in COMPILED_IN:
        assert module.__file__ is not None
        file = tmp_path / Path(module.__file__).name
        file.write_bytes(Path(module.__file__).read_bytes() + b"\n# edited\n")
        with monkeypatch.context() as patch:
            patch.setattr(module, "__file__", str(file))
            assert digest(b"text", COMPILED_IN) != before


def test_everything_that_is_compiled_in_counts() -> None:
    # whatever compiled text imports from the package must be part of the digest
    counted = {module.__name__ for module in COMPILED_IN}
    texts = [Path(str(module.__file__)).read_text("utf-8") for module in COMPILED_IN]
    crowd = Crowd(social_forces())
    texts += [source(model) for model in (Traffic([make_law("lin")]), crowd)]
    for text in texts:
        for line in text.splitlines():
            if line.startswith("from nnode."):
                assert line.split()[1] in counted, line


def test_a_cache_that_cannot_be_written(tmp_path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NNODE_CACHE", str(tmp_path / "file"))
    lane = Traffic([make_law("lin")]).formula
    assert lane is not None
    with pytest.raises(ConfigError, match="NNODE_CACHE"):
        lanes.compiled.__wrapped__(LaneSource(lane))


def test_the_source_can_be_read() -> None:
    for model, term in (
        (Traffic([make_law("lin"), RelativeSpeed(kappa=0.2)]), "relative_speed.kappa"),
        (Crowd(social_forces()), "social_force.pair_x = sum over others of"),
    ):
        text = source(model)
        compile(text, "generated", "exec")
        assert term in text.split('"""')[1]


def test_one_law_of_other_values_is_one_module() -> None:
    bodies = {"A": 4.0, "k": 5.0, "kappa": 6.0, "r": 0.3, "B": 0.2, "mass": 70.0}
    models = [
        Crowd(social_forces()),
        Crowd([make_law("relaxation", tau=0.5), *social_forces(**bodies)[1:]]),
    ]
    assert len({source(model) for model in models}) == 1
