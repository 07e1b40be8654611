"""``nnode study``: options, folders, interruption, continuation."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pandas as pd
import pytest
from omegaconf import OmegaConf

from nnode.errors import ConfigError
from studies import command as study
from studies.options import CrowdStudyOptions, TrafficStudyOptions
from tests.app.conftest import composed
from tests.app.forked import Forks

#: The command with a small study in place of the traffic study.
CODE = """
import sys
from studies import command as study
from nnode.app.cli.run import run
if __name__ == "__main__":
    study.STUDIES["traffic"] = "tests.studies.tiny"
    run("study", study.study)
"""


@pytest.mark.parametrize(
    ("name", "kind"), [("traffic", TrafficStudyOptions), ("crowd", CrowdStudyOptions)]
)
def test_study_composes_with_its_folder(name: str, kind: type) -> None:
    config = composed("study", f"study={name}", "study.quick=true", "study.workers=3")
    assert config.hydra.run.dir == f"runs/study/{name}"
    assert isinstance(OmegaConf.to_object(config.study), kind)
    assert name in study.STUDIES


def test_invalid_options_are_refused(tmp_path: Path) -> None:
    for change, message in (
        ({"workers": 0}, "study.workers=0 must be at least 1"),
        ({"name": "rail"}, "study.name=rail is unknown, expected one of traffic, crowd"),
    ):
        options = OmegaConf.structured(TrafficStudyOptions(**change))
        with pytest.raises(ConfigError, match=message):
            study.study(OmegaConf.create({"study": options}), tmp_path)


def test_interrupted_study_continues(forks: Forks, tmp_path: Path) -> None:
    command = ["study=traffic", "study.workers=1", f"hydra.run.dir={tmp_path}"]
    process = forks.start(CODE, *command)
    started = tmp_path / "sign-a"
    while process.poll() is None and not started.exists():
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGINT, errors
    assert "stopped by SIGINT: 2 of 4 tasks are kept" in errors
    assert "Traceback" not in errors
    (tmp_path / "awake").write_text("")
    process = forks.start(CODE, *command)
    output, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    assert (tmp_path / "calls").read_text().split() == ["1", "2"]
    for line in (f"page: {tmp_path / 'study.html'}", f"as Markdown: {tmp_path / 'study.md'}"):
        assert line in output.splitlines()
    assert list(pd.read_csv(tmp_path / "squares.csv")["y"]) == [1.0, 4.0]
    page = (tmp_path / "study.md").read_text()
    assert page.startswith("# Squares\n\nOf *two* numbers.\n")
    assert f"- Command: nnode study {' '.join(command)}" in page
    assert "torch" in page


def test_quick_results_have_a_separate_folder(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setitem(study.STUDIES, "traffic", "tests.studies.tiny")
    (tmp_path / "quick").mkdir()
    (tmp_path / "quick" / "awake").write_text("")
    options = OmegaConf.structured(TrafficStudyOptions(quick=True, workers=1))
    study.study(OmegaConf.create({"study": options}), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["quick"]
    assert (tmp_path / "quick" / "study.md").read_text().startswith("# Squares (quick)\n")
    assert f"tables: 1 CSV files in {tmp_path / 'quick'}" in capsys.readouterr().out
