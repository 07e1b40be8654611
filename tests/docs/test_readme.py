"""Commands, links and examples of the README and the documentation."""

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

#: Options that exist only after earlier steps of a page.
LOCAL = {"model=lin_with_speed_zone", "data=i80"}


@pytest.mark.thorough
@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_options_of_commands_exist(page: Path) -> None:
    for language, text in blocks(page):
        for command in examples(text) if language == "sh" else []:
            if "…" not in command and not LOCAL & set(command):
                composed(*command)


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_nothing_stands_twice(page: Path) -> None:
    """No heading, anchor or paragraph; edits of pages have doubled sections before."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.M | re.S)
    paragraphs = [part.strip() for part in text.split("\n\n")]
    long = [part for part in paragraphs if len(part) > 150]
    anchors = re.findall(r"<a id=.*?>", text)
    for parts in (re.findall(r"^#+ .*", text, re.M), anchors, long):
        assert sorted(parts) == sorted(set(parts))


def test_links_exist() -> None:
    links = re.findall(r"\]\(([^)#]+)", README.read_text())
    assert len(links) > 10
    for link in links:
        assert (ROOT / link).exists(), link


@pytest.mark.thorough
def test_python_example_with_own_data(tmp_path: Path) -> None:
    text = "".join(t for lang, t in blocks(README) if lang == "python" and "mine.csv" in t)
    drives = as_table(platoons(number=6, seconds=8.0)).drop(columns="recording")
    names = {"sequence": "platoon", "time": "t", "agent": "car", "x": "pos"}
    drives.rename(columns=names).to_csv(tmp_path / "mine.csv", index=False)
    output = run_code(text, tmp_path)
    assert re.search(r" Log-likelihood +-?\d", output, re.M)
    assert re.search(r"^v0 +\d+(\.\d+)? .* m/s$", output, re.M)
    for name in ("law.png", "map.png"):
        assert (tmp_path / name).stat().st_size > 10_000
    assert (tmp_path / "runs" / "mine" / "report.html").is_file()


@pytest.mark.thorough
def test_scikit_learn_example(tmp_path: Path) -> None:
    pytest.importorskip("sklearn")
    (text,) = (t for lang, t in blocks(README) if lang == "python" and "cross_val_score" in t)
    table(platoons=8, seconds=10.0).to_csv(tmp_path / "platoons.csv", index=False)
    script = f"{text}\nassert len(simulated) == 8 * 101 * 3\nprint(list(idm.parameters_))"
    output = run_code(script, tmp_path)
    assert re.search(r"^idm.T +1\.\d+ +1\.\d+ +1\.\d+ +s *$", output, re.M)
    assert "['estimate', 'lower', 'upper', 'unit'" in output
    scores = re.findall(r"-\d+\.\d+", output.partition("\n[")[2].partition("]")[0])
    assert len(scores) == 4
    chain = re.search(r"`(nnode\.Calibrator\(.*?\.score\(table\))`", README.read_text())
    assert chain is not None
    code = (
        f"import nnode\nimport pandas as pd\ntable = pd.read_csv('platoons.csv')\nprint({chain[1]})"
    )
    assert -1 < float(run_code(code, tmp_path)) < 0


def run_code(code: str, folder: Path) -> str:
    """The output of code that runs in a folder."""
    result = subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        env={"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "PATH": ""},
    )
    assert result.returncode == 0, result.stderr
    return result.stdout
