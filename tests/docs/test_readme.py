"""What the README says can be typed."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.app.conftest import composed, examples
from tests.app.following import table
from tests.builders import as_table
from tests.diagnosis.platoons import platoons
from tests.docs.test_tutorials import ROOT, blocks

README = ROOT / "README.md"
PAGES = [
    README,
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs" / "tutorials").glob("*")),
]

#: Choices that a page lets its reader make first.
MADE = {"model=lin_with_speed_zone", "data=i80"}


@pytest.mark.thorough
@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_every_command_has_options_that_exist(page: Path) -> None:
    for language, text in blocks(page):
        for command in examples(text) if language == "sh" else []:
            if "…" not in command and not MADE & set(command):
                composed(*command)


def test_every_link_leads_somewhere() -> None:
    links = re.findall(r"\]\(([^)#]+)", README.read_text())
    assert len(links) > 10
    for link in links:
        assert (ROOT / link).exists(), link


@pytest.mark.thorough
def test_your_own_data_in_python(tmp_path: Path) -> None:
    text = "".join(t for lang, t in blocks(README) if lang == "python" and "mine.csv" in t)
    drives = as_table(platoons(number=6, seconds=8.0)).drop(columns="recording")
    names = {"sequence": "platoon", "time": "t", "agent": "car", "x": "pos"}
    drives.rename(columns=names).to_csv(tmp_path / "mine.csv", index=False)
    said = in_a_folder(text, tmp_path)
    assert re.search(r" Log-likelihood +-?\d", said, re.M)
    assert re.search(r"^v0 +\d+(\.\d+)? .* m/s$", said, re.M)
    for name in ("law.png", "map.png"):
        assert (tmp_path / name).stat().st_size > 10_000
    assert (tmp_path / "runs" / "mine" / "report.html").is_file()


@pytest.mark.thorough
def test_the_lines_with_scikit_learn(tmp_path: Path) -> None:
    pytest.importorskip("sklearn")
    (text,) = (t for lang, t in blocks(README) if lang == "python" and "cross_val_score" in t)
    table(platoons=8, seconds=10.0).to_csv(tmp_path / "platoons.csv", index=False)
    script = f"{text}\nassert len(simulated) == 8 * 101 * 3\nprint(list(idm.parameters_))"
    said = in_a_folder(script, tmp_path)
    assert re.search(r"^idm.T +1\.\d+ +1\.\d+ +1\.\d+ +s *$", said, re.M)
    assert "['estimate', 'lower', 'upper', 'unit'" in said
    scores = re.findall(r"-\d+\.\d+", said.partition("\n[")[2].partition("]")[0])
    assert len(scores) == 4
    chain = re.search(r"`(nnode\.Calibrator\(.*?\.score\(table\))`", README.read_text())
    assert chain is not None
    code = (
        f"import nnode\nimport pandas as pd\ntable = pd.read_csv('platoons.csv')\nprint({chain[1]})"
    )
    assert -1 < float(in_a_folder(code, tmp_path)) < 0


def in_a_folder(code: str, folder: Path) -> str:
    """What code prints."""
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        env={"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "PATH": ""},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
