"""Contracts of imports: layers and no cycles."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

LINT = "from importlinter.cli import lint_imports; raise SystemExit(lint_imports(no_cache=True))"


def lint(root: Path) -> subprocess.CompletedProcess[str]:
    """Check the package in a folder with the contracts of its ``pyproject.toml``."""
    # in a subprocess, because import-linter imports the package from the current folder
    return subprocess.run(
        [sys.executable, "-c", LINT], cwd=root, capture_output=True, text=True, check=False
    )


def test_contracts_hold() -> None:
    result = lint(ROOT)
    assert result.returncode == 0, result.stdout + result.stderr


#: A file, a line at its end, and the message of the broken contract.
WRONG = [
    ("nnode/data/store.py", "import nnode.model.term", "nnode.data -> nnode.model"),
    (
        "nnode/model/term.py",
        "def late():\n    import nnode.simulation",
        "nnode.model -> nnode.simulation",
    ),
    (
        "nnode/plots/style.py",
        "if TYPE_CHECKING:\n    import nnode.diagnosis.single_law",
        "nnode.plots -> nnode.diagnosis",
    ),
    ("nnode/simulation/base.py", "from nnode import load", "nnode.simulation -> nnode.app"),
    ("nnode/errors.py", "import nnode.files", "nnode.errors -> nnode.files"),
    ("nnode/app/laws.py", "import benchmarks.synthetic_cases", "nnode -> benchmarks"),
    (
        "benchmarks/synthetic_cases/case.py",
        "import nnode.model",
        "benchmarks.synthetic_cases -> nnode.model",
    ),
    ("benchmarks/config.py", "import benchmarks.speed", "benchmarks.config -> benchmarks.speed"),
    ("nnode/data/sequence.py", "import nnode.data.store", "No cycles are allowed in nnode.data."),
    (
        "benchmarks/fault_injection/child.py",
        "import benchmarks.fault_injection.jobs",
        "No cycles are allowed in benchmarks.fault_injection.",
    ),
    ("nnode/homeless.py", "", "nnode.homeless"),
]


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The report on a copy of the packages with all wrong lines."""
    folder = tmp_path_factory.mktemp("wrong")
    for package in ("nnode", "studies", "benchmarks"):
        ignore = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / package, folder / package, ignore=ignore)
    shutil.copy(ROOT / "pyproject.toml", folder)
    for file, line, _ in WRONG:
        with (folder / file).open("a", encoding="utf-8") as source:
            source.write(f"\n{line}\n")
    result = lint(folder)
    assert result.returncode == 1
    return result.stdout


@pytest.mark.parametrize("message", [message for _, _, message in WRONG])
def test_wrong_imports_are_reported(output: str, message: str) -> None:
    assert message.replace(" -> ", " is not allowed to import ") in output
