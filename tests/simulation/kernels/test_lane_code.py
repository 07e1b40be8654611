"""Compiled code: vector instructions, and digests of the cache."""

from __future__ import annotations

import platform
import re
from pathlib import Path

import numba
import numpy as np
import pytest
import torch

from nnode.errors import ConfigError
from nnode.model import Crowd, System, Traffic, make_law
from nnode.model.effects.lane import RelativeSpeed
from nnode.simulation import FusedSolver
from nnode.simulation.kernels import functions, lanes, source
from nnode.simulation.kernels.cache import digest
from nnode.simulation.kernels.lanes import LaneSource
from nnode.simulation.kernels.runs import COMPILED_IN
from tests.builders import social_forces
from tests.simulation.fused.compare import gradient, single

#: Vector divisions by processor.
PACKED = {
    "x86_64": r"\sv?divp[sd]\s",
    "AMD64": r"\sv?divp[sd]\s",
    "aarch64": r"\sfdiv(\.[24][sd])?\s+v",
    "arm64": r"\sfdiv(\.[24][sd])?\s+v",
}
#: Scalar calls of the mathematical library.
LIBRARY = r"\b(call\w*|movabsq|bl|adrp)\s[^\n]*\b(exp2?|expm1|log1p|log2?|pow)f?\b"
#: Calls of the package's functions that were not inlined.
CALLED = r"\b(call\w*|movabsq|bl)\s[^\n]*\b_ZN5nnode8simulate\w*functions"


def is_vector_code(text: str, loops: int = 1) -> bool:
    """Whether assembly has at least so many vector divisions and no calls."""
    packed = len(re.findall(PACKED[platform.machine()], text)) >= loops
    return packed and not re.search(LIBRARY, text) and not re.search(CALLED, text)


@pytest.fixture
def fresh(tmp_path, monkeypatch) -> Path:
    """An empty cache on disk and in memory."""
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
def test_loops_are_vector_code(law, dtype, ragged, fresh, monkeypatch) -> None:
    modules = []
    load = lanes.compiled

    def load_and_record(code: LaneSource) -> object:
        modules.append(load(code))
        return modules[-1]

    monkeypatch.setattr(lanes, "compiled", load_and_record)
    batch = single(ragged).to(dtype=dtype)
    gradient(Traffic([make_law(law)]).to(dtype), FusedSolver(0.1), batch)
    # the derivatives of every law have a division
    function = modules[-1].backward
    (signature,) = function.signatures
    assert is_vector_code(function.inspect_asm(signature))


@pytest.mark.skipif(platform.machine() not in PACKED, reason="unknown instruction set")
@pytest.mark.parametrize("body", ["np.exp(-x[i])", "np.log(x[i] + 2)", "far(x[i])", "exp(-x[i])"])
def test_is_vector_code(body: str) -> None:
    @numba.njit(error_model="numpy", inline="never")
    def far(x: float) -> float:
        return np.exp(-x)

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


def test_digest_depends_on_compiled_modules(tmp_path, monkeypatch) -> None:
    before = digest(b"text", COMPILED_IN)
    assert digest(b"other", COMPILED_IN) != before
    for module in COMPILED_IN:
        file = tmp_path / Path(module.__file__).name
        file.write_bytes(Path(module.__file__).read_bytes() + b"\n# edited\n")
        with monkeypatch.context() as patch:
            patch.setattr(module, "__file__", str(file))
            assert digest(b"text", COMPILED_IN) != before


def test_all_imports_of_compiled_code_are_in_the_digest() -> None:
    modules = {module.__name__ for module in COMPILED_IN}
    texts = [Path(str(module.__file__)).read_text("utf-8") for module in COMPILED_IN]
    texts += [source(model) for model in (Traffic([make_law("lin")]), Crowd(social_forces()))]
    for text in texts:
        assert set(re.findall(r"^from (nnode\.\S+)", text, re.MULTILINE)) <= modules


def test_cache_that_cannot_be_written(tmp_path, monkeypatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NNODE_CACHE", str(tmp_path / "file"))
    with pytest.raises(ConfigError, match="NNODE_CACHE"):
        lanes.compiled.__wrapped__(LaneSource(Traffic([make_law("lin")]).formula))


@pytest.mark.parametrize(
    ("model", "term"),
    [
        (Traffic([make_law("lin"), RelativeSpeed(kappa=0.2)]), "relative_speed.kappa"),
        (Crowd(social_forces()), "social_force.pair_x = sum over others of"),
    ],
    ids=["lane", "crowd"],
)
def test_source(model: System, term: str) -> None:
    text = source(model)
    compile(text, "generated", "exec")
    assert term in text.split('"""')[1]


def test_source_does_not_depend_on_parameter_values() -> None:
    force = social_forces(A=4.0, k=5.0, kappa=6.0, r=0.3, B=0.2, mass=70.0)[1]
    changed = Crowd([make_law("relaxation", tau=0.5), force])
    assert source(changed) == source(Crowd(social_forces()))
