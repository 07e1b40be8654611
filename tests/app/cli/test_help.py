"""Help texts: purpose, choices, options, and examples that compose."""

from __future__ import annotations

import re
import signal
from dataclasses import fields
from pathlib import Path

import pytest

from benchmarks import config as benchmark_config
from nnode.app.cli.help import first_comment, help_text, remarks
from nnode.config import SCHEMAS
from nnode.program import words
from tests.app.conftest import CONF, ROOT, Script, composed, examples

SCRIPTS = sorted(path.stem for path in (ROOT / "scripts").glob("*.py"))


@pytest.mark.thorough
@pytest.mark.parametrize("name", SCRIPTS)
def test_help_names_purpose_choices_options_and_results(name: str) -> None:
    config = composed(name)
    text = help_text(name, config)
    assert text.splitlines()[0].endswith(".")
    assert "\nExamples:\n" in text
    assert "\nResults: " in text
    assert "hydra.run.dir=FOLDER" in text
    for group, chosen in config.hydra.runtime.choices.items():
        assert group.startswith("hydra/") or f"\n{group}=\n" in text
        assert group.startswith("hydra/") or chosen is None or f"\n  * {chosen} " in text
    assert max(len(line) for line in text.splitlines()) <= 100
    assert not re.search(r":\w+:`|``", text)  # markup of docstrings
    assert not re.search(r"((?:\w+ \| )+\w+): \1", text)  # repeated choices


@pytest.mark.parametrize("name", SCRIPTS)
def test_examples_compose(name: str) -> None:
    commands = examples(words(name))
    assert commands
    for command in commands:
        assert command[0] == name
        composed(*command)


def test_examples_are_extracted_from_text() -> None:
    (command,) = examples("Examples:\n  nnode train modle=lin \\\n    seed=1\n")
    assert command == ["train", "modle=lin", "seed=1"]


def test_every_option_and_choice_is_documented() -> None:
    groups = {"model", "data", "solver", "optimizer", "trainer", "study", "split", "loader"}
    groups |= {"discover", "benchmark", "benchmark_discovery"}
    for key, schema in {**SCHEMAS, **benchmark_config.SCHEMAS}.items():
        kind = schema if isinstance(schema, type) else type(schema)
        undocumented = {field.name for field in fields(kind)} - set(remarks(kind)) - groups
        assert not undocumented, f"{key}: {undocumented} need a comment, which is their help"
    for path in CONF.glob("*/*.yaml"):
        assert re.fullmatch(r".+\.", first_comment(path)), path


def test_help_shows_the_user_s_choices(script: Script, tmp_path: Path) -> None:
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "mine.yaml").write_text(
        "# A law of my own.\ndefaults: [lin_schema, _self_]\nname: mine\nv0: 12.0\n"
    )
    options = ["--config-dir", str(tmp_path), "model=mine", "solver=fused", "seed=7"]
    done = script("train", "--help", *options)
    assert done.stderr == ""
    assert done.stdout.startswith("Calibrate a model to measured trajectories.")
    for line in (
        *("  * mine          A law of my own.", "  model.v0=12.0 ", "  solver.cutoff=null "),
        *("  trainer.monitor=train           train | heldout: ", "  seed=7              "),
    ):
        assert line in done.stdout


#: A command whose standard output is a closed pipe.
CLOSED_PIPE = """
import os
from nnode.app.commands.evaluate import main
reader, writer = os.pipe()
os.dup2(writer, 1)
os.close(reader)
main()
"""


def test_closed_pipe_is_no_error(script: Script) -> None:
    assert script(CLOSED_PIPE, "--help", status=-signal.SIGPIPE).stderr == ""
