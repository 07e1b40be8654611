"""The code of each tutorial runs in a separate folder."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TUTORIALS = ROOT / "docs" / "tutorials"
#: Tutorials that calibrate the real recordings.
REAL = {"esimas", "juelich", "own_term", "cluster"}

#: Runs blocks in their order; Python blocks share a namespace.
DRIVER = """
import subprocess, sys
from pathlib import Path
names = {}
for path in sys.argv[1:]:
    text = Path(path).read_text()
    print("##", path, flush=True)
    if path.endswith(".sh"):
        done = subprocess.run(["bash", "-euo", "pipefail", "-c", text])
        if done.returncode:
            sys.exit(f"{path} ended with {done.returncode}:\\n{text}")
    else:
        exec(compile(text, path, "exec"), names)
"""


def blocks(page: Path) -> list[tuple[str, str]]:
    """Language and text of each code block."""
    return re.findall(r"^```(python|sh)\n(.*?)^```", page.read_text(), re.M | re.S)


def names() -> list[str]:
    return sorted(page.stem for page in TUTORIALS.glob("*.md"))


@pytest.mark.tutorial
@pytest.mark.parametrize("name", names())
def test_tutorial_runs(name: str, tmp_path: Path) -> None:
    if name in REAL and not os.environ.get("NNODE_DATA"):
        pytest.skip("real recordings absent: set NNODE_DATA to a folder with esimas/ and juelich/")
    for folder in ("conf", "scripts"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    files = []
    for number, (language, text) in enumerate(blocks(TUTORIALS / f"{name}.md")):
        file = tmp_path / f"block{number}.{'sh' if language == 'sh' else 'py'}"
        file.write_text(text)
        files.append(file.name)
    assert files, f"{name}.md shows no code"
    interpreter = Path(sys.executable)
    env = {
        **os.environ,
        "PATH": f"{interpreter.parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "MPLBACKEND": "agg",
    }
    done = subprocess.run(
        [str(interpreter), "-c", DRIVER, *files],
        cwd=tmp_path,
        env=env,
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, f"{done.stdout[-3000:]}\n{done.stderr[-3000:]}"


@pytest.mark.tutorial
def test_site_builds_without_warnings(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs")
    pytest.importorskip("material")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    page = (tmp_path / "site" / "index.html").read_text()
    # the site works offline
    assert not re.findall(r'(?:src|href)="(?:https?:)?//[^"]+\.(?:js|css|woff2?)', page)


def test_tutorials_are_in_the_table_of_contents() -> None:
    contents = (ROOT / "mkdocs.yml").read_text()
    missing = [name for name in names() if f"tutorials/{name}.md" not in contents]
    assert not missing
