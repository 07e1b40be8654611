"""The wheel, built and installed into an environment that knows no checkout."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import venv
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCES = ("nnode", "studies", "conf", "setup.py", "pyproject.toml", "README.md", "LICENSE")

Run = Callable[..., subprocess.CompletedProcess[str]]


def built(folder: Path) -> Path:
    """The wheel, built in a folder from a copy, so that the checkout stays as it is."""
    for name in SOURCES:
        if (ROOT / name).is_dir():
            ignore = shutil.ignore_patterns("__pycache__")
            shutil.copytree(ROOT / name, folder / "source" / name, ignore=ignore)
        else:
            shutil.copy(ROOT / name, folder / "source")
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "pip",
            "wheel",
            "--quiet",
            "--no-deps",
            "--no-build-isolation",
            "--no-index",
            "--wheel-dir",
            str(folder),
            str(folder / "source"),
        ],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    (found,) = folder.glob("nnode-*.whl")
    return found


def installed(wheel: Path, place: Path, **more: str) -> Run:
    """Runs a program of an environment that has the wheel and, lent, what the wheel depends on.

    It runs in the folder ``work``, which is empty at first.

    Args:
        more: variables of the environment.
    """
    venv.create(place / "venv", with_pip=False)
    python = place / "venv" / "bin" / "python"
    lent = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
    (site,) = (place / "venv" / "lib").glob("python*/site-packages")
    # of a folder that is named in such a file no .pth file is read, so that no checkout is lent
    (site / "lent.pth").write_text("\n".join(lent))
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "pip",
            "--python",
            str(python),
            "install",
            "--quiet",
            "--no-deps",
            "--no-index",
            "--ignore-installed",
            str(wheel),
        ],
        cwd=place,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    env = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    work = place / "work"
    work.mkdir()

    def run(program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [str(python.parent / program), *arguments],
            cwd=work,
            capture_output=True,
            text=True,
            env={**env, "OMP_NUM_THREADS": "1", "NNODE_DATA": "", "MPLBACKEND": "agg", **more},
            check=False,
        )

    return run
