"""Compiled code: vector instructions, laws from elsewhere, and what is kept between processes."""

from __future__ import annotations

import importlib
import json
import os
import platform
import re
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
import torch

from nnode.errors import ConfigError
from nnode.models import Linear, Logarithmic, NetworkSpeed, Traffic
from nnode.solvers import FusedSolver, TorchdiffeqSolver
from nnode.solvers.fused import _generate, _math, laws, traffic
from nnode.solvers.fused._templates import TEMPLATE
from tests.solvers.fused import saturation
from tests.solvers.fused.compare import difference, gradient, single

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
CALLED = r"\b(call\w*|movabsq|bl)\s[^\n]*\b_ZN5nnode7solvers5fused\w*_(math|polynomials)"


def is_vector_code(text: str, loops: int = 2) -> bool:
    """Whether assembly divides several numbers at once, in so many places, and calls nothing."""
    packed = len(re.findall(PACKED[platform.machine()], text)) >= loops
    return packed and not re.search(LIBRARY, text) and not re.search(CALLED, text)


@pytest.fixture
def fresh(tmp_path, monkeypatch) -> Path:  # type: ignore[no-untyped-def]
    """An empty cache, and modules loaded from it."""
    monkeypatch.setenv("NNODE_CACHE", str(tmp_path))
    plain = _generate.compiled.__wrapped__
    monkeypatch.setattr(traffic, "compiled", plain)
    return Path(tmp_path)


@pytest.mark.skipif(platform.machine() not in PACKED, reason="unknown instruction set")
@pytest.mark.parametrize("law", [Linear, Logarithmic, NetworkSpeed])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_loops_are_vector_code(law, dtype, ragged, fresh, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    # losing this makes everything ten times slower and nothing else would tell
    modules = []
    load = traffic.compiled

    def remember(kernel: laws.LawKernel) -> object:
        modules.append(load(kernel))
        return modules[-1]

    monkeypatch.setattr(traffic, "compiled", remember)
    batch = single(ragged).to(dtype=dtype)
    gradient(Traffic([law()]).to(dtype), FusedSolver(0.1), batch)
    # every law divides in its derivatives, in the loops of the first and of further shares
    function = modules[-1].backward
    (signature,) = function.signatures
    assert is_vector_code(function.inspect_asm(signature))


@pytest.mark.skipif(platform.machine() not in PACKED, reason="unknown instruction set")
@pytest.mark.parametrize("body", ["np.exp(-x[i])", "np.log(x[i] + 2)", "far(x[i])", "exp(-x[i])"])
def test_the_guard_sees_scalar_code(body: str) -> None:
    @numba.njit(error_model="numpy", inline="never")
    def far(x: float) -> float:
        return np.exp(-x)  # type: ignore[no-any-return]

    names = {"np": np, "far": far, "exp": _math.exp}
    text = f"""
def run(x, out):
    for i in range(len(x)):
        out[i] = x[i] / (1 + {body})
    for i in range(len(x)):
        out[i] = x[i] / (3 + out[i])
"""
    exec(text, names)
    run = numba.njit(error_model="numpy", fastmath=_math.FLAGS)(names["run"])
    run(np.ones(4), np.ones(4))
    assert is_vector_code(run.inspect_asm(run.signatures[0])) == (body == "exp(-x[i])")


def test_a_law_from_elsewhere(ragged, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setattr(laws, "_KERNELS", dict(laws._KERNELS))
    batch, model = single(ragged), Traffic([saturation.Saturation()])
    assert not traffic.supports(model, batch)
    laws.register(saturation.Saturation, saturation.share, saturation.pull, saturation.pack, size=2)
    assert traffic.supports(model, batch)
    exact, wanted = gradient(model, TorchdiffeqSolver("euler", "discrete", 0.02), batch)
    found, own = gradient(model, FusedSolver(0.02), batch)
    torch.testing.assert_close(found.x, exact.x, rtol=1e-13, atol=1e-12)
    assert difference(own, wanted) < 1e-10


def test_functions_must_be_importable() -> None:
    def local(gap: float, v0: float) -> float:
        return v0

    with pytest.raises(ValueError, match="cannot be imported by name"):
        laws.register(saturation.Saturation, local, saturation.pull, saturation.pack, 2)
    with pytest.raises(ValueError, match="at least one parameter"):
        laws.register(saturation.Saturation, saturation.share, saturation.pull, saturation.pack, 0)


def test_an_edited_law_gets_a_new_name(tmp_path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    file = tmp_path / "edited_law.py"
    monkeypatch.syspath_prepend(str(tmp_path))
    text = Path(saturation.__file__).read_text(encoding="utf-8")
    file.write_text(text, encoding="utf-8")
    module = importlib.import_module("edited_law")
    kernel = laws.LawKernel(module.share, module.pull, module.pack, 2)
    source = _generate.source(kernel)
    before = _generate._digest(source, kernel)
    assert before == _generate._digest(source, kernel)
    file.write_text(text.replace("real(1, gap)", "real(2, gap)"), encoding="utf-8")
    assert before != _generate._digest(source, kernel)


def test_an_edit_of_what_laws_share_changes_the_name(tmp_path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    kernel = laws.kernel_of(NetworkSpeed())
    assert kernel is not None
    before = _generate._digest("text", kernel)
    for module in _generate._COMPILED_IN:
        assert module.__file__ is not None
        file = tmp_path / Path(module.__file__).name
        file.write_bytes(Path(module.__file__).read_bytes() + b"\n# edited\n")
        with monkeypatch.context() as patch:
            patch.setattr(module, "__file__", str(file))
            assert _generate._digest("text", kernel) != before


def test_everything_that_is_compiled_into_a_law_counts() -> None:
    # whatever a compiled file imports from the package must be part of the digest
    counted = {module.__name__ for module in _generate._COMPILED_IN}
    texts = {
        name: (Path(_generate.__file__).with_name(f"{name}.py")).read_text(encoding="utf-8")
        for name in ("_math", "_polynomials", "_rows")
    }
    texts["template"] = TEMPLATE
    for name, text in texts.items():
        for line in text.splitlines():
            if line.startswith("from nnode."):
                assert line.split()[1] in counted, f"{name}: {line}"


def test_a_cache_that_cannot_be_written(tmp_path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NNODE_CACHE", str(tmp_path / "file"))
    kernel = laws.kernel_of(Linear())
    assert kernel is not None
    with pytest.raises(ConfigError, match="NNODE_CACHE"):
        _generate.compiled.__wrapped__(kernel)


SCRIPT = """
import json, sys
import numpy as np, torch
from nnode.data.sequence import Sequence, collate
from nnode.models import NetworkSpeed, Traffic
x = np.cumsum(np.full((3, 4, 1), 12.0), 1) + np.arange(3.0)[:, None, None]
batch = collate([Sequence(name="a", recording="a", time=0.2 * np.arange(3), x=x)])
model = Traffic([NetworkSpeed(4)])
from nnode.solvers import FusedSolver
FusedSolver()(model, batch).x.sum().backward()
from nnode.solvers.fused import _generate, laws
module = _generate.compiled(laws.kernel_of(model.terms[0]))
hits = [sum(f.stats.cache_hits.values()) for f in (module.forward, module.backward)]
print(json.dumps({"hits": hits}))
"""


def test_a_second_process_does_not_compile(tmp_path) -> None:  # type: ignore[no-untyped-def]
    environment = {**os.environ, "NNODE_CACHE": str(tmp_path)}
    runs = []
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        )
        runs.append(json.loads(done.stdout))
    assert [run["hits"] for run in runs] == [[0, 0], [1, 1]]
    assert len(list((tmp_path / "fused").glob("*.py"))) == 1
