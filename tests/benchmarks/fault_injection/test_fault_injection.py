"""Short campaigns of fault injection; complete campaigns with -m slow."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import strategies as st

from benchmarks.fault_injection.fuzz import fuzz
from benchmarks.fault_injection.jobs import jobs
from benchmarks.fault_injection.targets import Target
from tests.app.conftest import Script, composed


def run(script: Script, folder: Path, *overrides: str) -> dict[str, Any]:
    """The report of campaigns without losses."""
    script("fault_injection", *overrides, f"hydra.run.dir={folder}")
    report: dict[str, Any] = json.loads((folder / "report.json").read_text())
    assert report["losses"] == 0
    return report


@pytest.mark.thorough
def test_short_campaigns(script: Script, tmp_path: Path) -> None:
    report = run(script, tmp_path, "jobs=[prepare_data]", "kills=6", "repeats=2", "inputs=1150")
    assert report["tried"]["kills"] == 6
    assert report["tried"]["fuzz"] >= 1150
    assert report["tried"]["disk"] >= 6
    assert report["tried"]["folder"] >= 2
    rows = {(row["campaign"], row["what"]): row for row in report["rows"]}
    assert rows["kills", "prepare_data"]["facts"]["ends compared"] >= 1
    assert rows["disk", "prepare_data, size of files"]["facts"]["refused"] >= 3
    for (campaign, _), row in rows.items():
        if campaign == "fuzz":
            assert row["facts"]["read"] + row["facts"]["refused"] == row["tried"] >= 50
    # files of the campaigns are removed
    assert not {p.name for p in tmp_path.iterdir()} & {"kills", "disk", "fuzz"}


@pytest.mark.slow
def test_all_jobs(script: Script, tmp_path: Path) -> None:
    report = run(script, tmp_path, "campaigns=[kills,disk,folder]", "kills=50")
    assert report["tried"]["kills"] >= 50


@pytest.mark.slow
def test_many_inputs(script: Script, tmp_path: Path) -> None:
    report = run(script, tmp_path, "campaigns=[fuzz]", "inputs=104000")
    assert report["tried"]["fuzz"] >= 100_000


@pytest.mark.thorough
def test_misbehaving_readers_are_losses(tmp_path: Path) -> None:
    outside, scratch = tmp_path / "elsewhere", tmp_path / "fuzz"
    scratch.mkdir()

    def unknown(path: Path) -> None:
        raise KeyError("not an error of the package")

    def written(path: Path) -> None:
        outside.write_text("written outside")

    def large(path: Path) -> None:
        bytearray(1 << 40)

    readers = [unknown, written, large, lambda path: None]
    targets = [Target(str(i), "bad.bin", st.binary(), read) for i, read in enumerate(readers)]
    rows = list(fuzz(targets, scratch, 40, 0))
    losses = [" ".join(row.losses) for row in rows]
    assert "KeyError" in losses[0]
    assert f"did ['open {outside}" in losses[1]
    assert "MemoryError" in losses[2]
    assert (rows[3].losses, rows[3].tried, rows[3].facts["read"]) == ([], 10, 10)


def test_jobs_have_valid_options(tmp_path: Path) -> None:
    for job in jobs(tmp_path / "raw"):
        composed(job.name, *job.first)
