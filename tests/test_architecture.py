"""The packages' line is kept: imports go one way, and never in a circle."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("nnode", "studies", "benchmarks")

LINT = "from importlinter.cli import lint_imports; raise SystemExit(lint_imports(no_cache=True))"


def lint(root: Path) -> subprocess.CompletedProcess[str]:
    """Hold the package in a folder against the contracts of its ``pyproject.toml``."""
    # in a process of its own: the package to look at is the one that Python would import
    return subprocess.run(
        [sys.executable, "-c", LINT], cwd=root, capture_output=True, text=True, check=False
    )


def test_imports_go_one_way() -> None:
    done = lint(ROOT)
    assert done.returncode == 0, done.stdout + done.stderr


def with_line(file: str, line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """The same for a copy of the packages with another line at the end of a file."""
    for package in PACKAGES:
        ignore = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / package, folder / package, ignore=ignore)
    shutil.copy(ROOT / "pyproject.toml", folder)
    with (folder / file).open("a", encoding="utf-8") as source:
        source.write(f"\n{line}\n")
    return lint(folder)


@pytest.mark.parametrize(
    ("file", "line", "lower", "upper"),
    [
        ("nnode/data/store.py", "import nnode.model.term", "nnode.data", "nnode.model"),
        (
            "nnode/model/term.py",
            "def late():\n    import nnode.simulation",
            "nnode.model",
            "nnode.simulation",
        ),
        (
            "nnode/plots/style.py",
            "if TYPE_CHECKING:\n    import nnode.discover.diagnose",
            "nnode.plots",
            "nnode.discover",
        ),
        ("nnode/simulation/base.py", "from nnode import load", "nnode.simulation", "nnode.app"),
        ("nnode/errors.py", "import nnode.files", "nnode.errors", "nnode.files"),
        ("nnode/errors.py", "import benchmarks.synthetic_cases", "nnode", "benchmarks"),
        (
            "benchmarks/synthetic_cases/case.py",
            "import nnode.model",
            "benchmarks.synthetic_cases",
            "nnode.model",
        ),
        (
            "benchmarks/config.py",
            "import benchmarks.speed",
            "benchmarks.config",
            "benchmarks.speed",
        ),
    ],
)
def test_a_wrong_import_is_found(
    file: str, line: str, lower: str, upper: str, tmp_path: Path
) -> None:
    done = with_line(file, line, tmp_path)
    assert done.returncode == 1
    assert f"{lower} is not allowed to import {upper}" in done.stdout


@pytest.mark.parametrize(
    ("file", "line", "folder"),
    [
        ("nnode/data/sequence.py", "import nnode.data.store", "nnode.data"),
        (
            "benchmarks/fault_injection/child.py",
            "import benchmarks.fault_injection.jobs",
            "benchmarks.fault_injection",
        ),
    ],
)
def test_a_circle_is_found(file: str, line: str, folder: str, tmp_path: Path) -> None:
    done = with_line(file, line, tmp_path)
    assert done.returncode == 1
    assert f"No cycles are allowed in {folder}." in done.stdout


def test_a_package_without_a_place_is_found(tmp_path: Path) -> None:
    done = with_line("nnode/homeless.py", "", tmp_path)
    assert done.returncode == 1
    assert "nnode.homeless" in done.stdout
