"""The output folders of the scripts and their documentation."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from tests.app.conftest import composed

ROOT = Path(__file__).parents[1]
PAGES = ("runs/README.md", "data/README.md")


def git(*arguments: str) -> subprocess.CompletedProcess[str]:
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        pytest.skip("there is no git repository")
    return subprocess.run(
        ["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("page", PAGES)
def test_pages_describe_the_contents(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    assert "written by" in text
    assert "may be deleted" in text


@pytest.mark.parametrize("page", PAGES)
def test_only_the_page_is_committed(page: str) -> None:
    folder = page.partition("/")[0]
    assert git("ls-files", folder).stdout.split() == [page]
    assert git("check-ignore", "--no-index", "--quiet", page).returncode == 1
    assert git("check-ignore", "--no-index", "--quiet", f"{folder}/mine").returncode == 0


@pytest.mark.thorough
def test_output_folders_of_scripts_are_listed() -> None:
    pages = {page.partition("/")[0]: (ROOT / page).read_text(encoding="utf-8") for page in PAGES}
    for script in (ROOT / "scripts").glob("*.py"):
        settings = composed(script.stem).hydra
        for place in (settings.run.dir, settings.sweep.dir):
            top, name = place.split("/")[:2]
            assert f"`{name}/" in pages[top], place


@pytest.mark.skipif(shutil.which("make") is None, reason="there is no make")
def test_make_clean_keeps_the_pages(tmp_path: Path) -> None:
    shutil.copy(ROOT / "Makefile", tmp_path)
    for name in (*PAGES, "runs/demo/traffic", "runs/train/kept", "data/prepared/kept"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    subprocess.run(["make", "clean"], cwd=tmp_path, capture_output=True, check=True)
    left = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert left == {"Makefile", *PAGES, "runs/train/kept", "data/prepared/kept"}
