"""Every script's help says what it does, what can be chosen, and gives examples that work."""

from __future__ import annotations

import shlex
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import pytest
from hydra.core.global_hydra import GlobalHydra

from benchmarks import config as benchmark_config
from nnode.app.cli.choices import choices, own_groups
from nnode.app.cli.flags import read_command_line
from nnode.app.cli.help import help_text, remarks
from nnode.app.cli.run import check_overrides
from nnode.config import SCHEMAS
from nnode.program import words
from tests.app.conftest import ROOT, Script, environment, examples

CONF = ROOT / "conf"
SCRIPTS = sorted(path.stem for path in (ROOT / "scripts").glob("*.py"))


@pytest.fixture(autouse=True)
def _hydra() -> Iterator[None]:
    benchmark_config.register()
    yield
    assert not GlobalHydra.instance().is_initialized()


@pytest.mark.parametrize("name", SCRIPTS)
def test_help_names_purpose_groups_choices_options_and_results(name: str) -> None:
    text = help_text([], CONF, name)
    assert text.splitlines()[0].endswith(".")
    assert "\nExamples:\n" in text
    assert "\nResults: " in text
    assert "hydra.run.dir=FOLDER" in text
    assert "${" not in text
    for group in own_groups(CONF, name):
        assert f"\n{group}=   (" in text
        for choice in choices(CONF, group):
            assert f" {choice.name} " in text, choice
    assert max(len(line) for line in text.splitlines()) <= 100


@pytest.mark.parametrize("name", SCRIPTS)
def test_every_example_has_options_that_exist(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setenv("NNODE_SCRIPTS", str(ROOT))
    commands = examples(words(name, CONF))
    assert commands
    for command in commands:
        parts = shlex.split(command)
        place = next(i for i, part in enumerate(parts) if part.startswith("scripts/"))
        assert parts[place] == f"scripts/{name}.py"
        line = read_command_line(parts[place + 1 :])
        check_overrides(line.overrides, CONF, name, sweep=line.sweeps)


def test_a_wrong_example_would_be_found() -> None:
    (command,) = examples("Examples:\n  python scripts/train.py modle=lin \\\n    seed=1\n")
    assert command == "python scripts/train.py modle=lin seed=1"


def test_every_option_says_what_it_means() -> None:
    groups = {"model", "data", "solver", "optimizer", "trainer", "study", "split", "loader"}
    groups |= {"discover", "benchmark", "benchmark_discovery"}
    for key, schema in {**SCHEMAS, **benchmark_config.SCHEMAS}.items():
        kind = schema if isinstance(schema, type) else type(schema)
        silent = {field.name for field in fields(kind)} - set(remarks(kind)) - groups
        assert not silent, f"{key}: a comment beside {silent} becomes their line of the help"


def test_every_choice_says_what_it_is() -> None:
    for folder in sorted(path for path in CONF.iterdir() if path.is_dir() and path.name != "hydra"):
        for choice in choices(CONF, folder.name):
            assert len(choice.words) > 3, f"{folder.name}={choice.name}"


def test_choices_change_what_is_shown() -> None:
    text = help_text(["model=n4", "solver=fused", "seed=7"], CONF, "train")
    assert "  * n4 " in text
    assert "  model.hidden=4 " in text
    assert "  solver.cutoff=null " in text
    assert "  seed=7 " in text
    assert "model.L_min" not in text
    assert "trainer.monitor=train           train | heldout: whose cost" in text


def test_choices_of_one_s_own_are_shown_and_taken(tmp_path: Path) -> None:
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "mine.yaml").write_text(
        "# A law of my own.\ndefaults: [lin_schema, _self_]\nname: mine\nv0: 12.0\n"
    )
    given = ["model=mine", "model.L=4"]
    check_overrides(given, CONF, "train", extra=tmp_path)
    text = help_text(given, CONF, "train", tmp_path)
    assert "  * mine          A law of my own." in text
    assert "  model.v0=12.0 " in text


def test_a_script_prints_its_help(script: Script) -> None:
    done = script("discover", "--help", "model=sf")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("Find what a model lacks: ")
    assert "  model.kappa=null " in done.stdout
    assert done.stderr == ""


def test_a_reader_that_has_seen_enough_is_no_error() -> None:
    command = [sys.executable, str(ROOT / "scripts" / "evaluate.py"), "--help"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment()
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 0
