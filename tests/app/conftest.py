"""Running commands as a user does."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig

from benchmarks.config import register
from nnode.app.cli import saved
from nnode.data.synthetic import demo_data
from tests.app.following import table
from tests.app.forked import Forks

ROOT = Path(__file__).resolve().parents[2]
CONF = ROOT / "conf"
#: Names that follow ``nnode`` or ``python`` on a command line.
COMMANDS = {
    *(path.stem for path in (ROOT / "nnode" / "app" / "commands").glob("[a-z]*.py")),
    *(f"scripts/{name}.py" for name in ("benchmark", "benchmark_discovery", "fault_injection")),
}

# Hydra's copy of all schemas takes a third of the time of a composition
ConfigStore.__deepcopy__ = lambda store, _: store  # type: ignore[attr-defined]

Script = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="session")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the demonstration recordings."""
    folder = tmp_path_factory.mktemp("raw")
    demo_data(folder)
    return folder


#: A command line of the program or of a benchmark script.
TYPED = re.compile(r"^ *(?:[A-Z_]+=\S+ )?(?:(?:torchrun \S+ -m )?nnode|python) (.*)", re.M)


def examples(text: str) -> list[list[str]]:
    """Name and options of each command in a text; continued lines are joined."""
    lines = TYPED.findall(text.replace("\\\n", " "))
    commands = [shlex.split(line, comments=True) for line in lines]
    return [[Path(name).stem, *words] for name, *words in commands if name in COMMANDS]


def composed(name: str, *words: str) -> DictConfig:
    """The configuration of a command line; for a sweep, of its first run."""
    overrides = [word for word in words if "=" in word and not word.startswith("-")]
    first = [
        f"{o.get_key_element()}={next(o.sweep_iterator())}" if o.is_sweep_override() else text
        for text, o in zip(
            overrides, OverridesParser.create().parse_overrides(overrides), strict=True
        )
    ]
    register()
    return saved.composed(name, first)


def read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def environment() -> dict[str, str]:
    """This process's environment with one torch thread and without a data folder."""
    return {**os.environ, "OMP_NUM_THREADS": "1", "NNODE_DATA": ""}


def background(
    *command: str, program: Sequence[str] = (sys.executable, "scripts/train.py"), **env: str
) -> subprocess.Popen[str]:
    """Start a process, by default a training; its output streams are pipes."""
    return subprocess.Popen(
        [*program, *command],
        cwd=ROOT,
        env={**environment(), **env},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.fixture(scope="session")
def forks() -> Iterator[Forks]:
    """Runs scripts without repeating slow imports."""
    processes = Forks(ROOT, environment())
    yield processes
    processes.close()


@pytest.fixture(scope="session")
def script(forks: Forks) -> Script:
    """Run ``scripts/<name>.py`` with overrides in a forked process; see `Forks.run`."""
    return forks.run


def trained_idm(script: Script, folder: Path, data: pd.DataFrame, *overrides: str) -> Path:
    """Train the IDM on a table and return the run's folder."""
    data.to_csv(folder / "mine.csv", index=False)
    options = f"model=idm data=table data.domain=traffic data.path={folder}/mine.csv".split()
    script("train", *options, *overrides, folder=folder / "run")
    return folder / "run"


@pytest.fixture(scope="session")
def idm_run(script: Script, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a short training on vehicles that follow the IDM exactly."""
    options = ("trainer.max_epochs=2", "trainer.drivers=none")
    return trained_idm(script, tmp_path_factory.mktemp("idm"), table(10, 10.0), *options)
