"""The demonstration of `make demo`, with fewer platoons and epochs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from studies.demo.study import demo


@pytest.mark.thorough
def test_demo_writes_one_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = demo(tmp_path, platoons=16, epochs=2)
    printed = capsys.readouterr().out
    assert printed.rstrip().endswith(f"{page}")
    assert "nnode check mine.csv" in printed
    assert "The model lin lacks speed_zone" in printed
    assert "No missing effect was found" in printed
    html = page.read_text(encoding="utf-8")
    assert len(html) < 3_000_000
    assert 'src="data:image/png' in html
    assert "http" not in html.replace("http://www.w3.org", "")
    report = json.loads((tmp_path / "diagnosis" / "report.json").read_text(encoding="utf-8"))
    assert [effect["name"] for effect in report["effects"]] == ["speed_zone"]
    for name in ("calibration", "diagnosis", "crowd"):
        assert (tmp_path / name / "checkpoints" / "best.pt").is_file()
    assert list((tmp_path / "crowd" / "tensorboard").glob("events.*"))
