"""Public names of the package."""

from __future__ import annotations

import subprocess
import sys

import nnode

NAMES = [
    "Calibration",
    "Calibrator",
    "Check",
    "Predictions",
    "Report",
    "Sequence",
    "Sequences",
    "Simulated",
    "__version__",
    "check",
    "diagnose",
    "drive",
    "fit",
    "load",
    "predict",
    "replay",
    "sequences",
    "simulate",
]


def test_dir_lists_public_names_without_importing_torch() -> None:
    code = "import sys, nnode; print(*dir(nnode)); print('torch' in sys.modules)"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.splitlines() == [" ".join(NAMES), "False"]


def test_public_names_exist() -> None:
    assert sorted(nnode.__all__) == dir(nnode)
    for name in dir(nnode):
        assert getattr(nnode, name) is not None
