"""The packages' line is kept: imports go one way, and never in a circle."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

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


#: A line at the end of a file, and what the contracts say of it.
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
def complaints(tmp_path_factory: pytest.TempPathFactory) -> str:
    """What is said of a copy of the packages that has all wrong lines."""
    folder = tmp_path_factory.mktemp("wrong")
    for package in ("nnode", "studies", "benchmarks"):
        ignore = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / package, folder / package, ignore=ignore)
    shutil.copy(ROOT / "pyproject.toml", folder)
    for file, line, _ in WRONG:
        with (folder / file).open("a", encoding="utf-8") as source:
            source.write(f"\n{line}\n")
    done = lint(folder)
    assert done.returncode == 1
    return done.stdout


@pytest.mark.parametrize(("file", "line", "words"), WRONG)
def test_a_wrong_import_is_found(complaints: str, file: str, line: str, words: str) -> None:
    assert words.replace(" -> ", " is not allowed to import ") in complaints
