"""Files and folders stay so small that one can see through them."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
FILES = [file for package in ("nnode", "benchmarks") for file in (ROOT / package).rglob("*.py")]

MOST_LINES = 400
MOST_FILES = 16


def test_files_stay_short() -> None:
    lines = {
        str(file.relative_to(ROOT)): len(file.read_text(encoding="utf-8").splitlines())
        for file in FILES
    }
    assert lines
    assert {file: number for file, number in lines.items() if number > MOST_LINES} == {}


def test_folders_stay_small() -> None:
    number = Counter(str(file.parent.relative_to(ROOT)) for file in FILES)
    assert {folder: files for folder, files in number.items() if files > MOST_FILES} == {}
