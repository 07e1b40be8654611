"""Running the scripts as a user does."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

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
#: What stands behind ``nnode`` or ``python``.
COMMANDS = {
    *(path.stem for path in (ROOT / "nnode" / "app" / "commands").glob("[a-z]*.py")),
    *(f"scripts/{name}.py" for name in ("benchmark", "benchmark_discovery", "fault_injection")),
}

# Hydra copies all schemas in every composition, which takes a third of its time
ConfigStore.__deepcopy__ = lambda store, _: store  # type: ignore[attr-defined]

Script = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="session")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the demonstration's recordings."""
    folder = tmp_path_factory.mktemp("raw")
    demo_data(folder)
    return folder


#: How a command of the program, or a script of the benchmarks, is typed.
TYPED = re.compile(r"^ *(?:[A-Z_]+=\S+ )?(?:(?:torchrun \S+ -m )?nnode|python) (.*)", re.M)


def examples(text: str) -> list[list[str]]:
    """Name and options of each command in a text, continued lines joined."""
    lines = TYPED.findall(text.replace("\\\n", " "))
    commands = [shlex.split(line, comments=True) for line in lines]
    return [[Path(name).stem, *words] for name, *words in commands if name in COMMANDS]


def composed(name: str, *words: str) -> DictConfig:
    """The configuration that a command line gives; of a sweep that of its first run."""
    overrides = [word for word in words if "=" in word and not word.startswith("-")]
    first = [
        f"{o.get_key_element()}={next(o.sweep_iterator())}" if o.is_sweep_override() else text
        for text, o in zip(
            overrides, OverridesParser.create().parse_overrides(overrides), strict=True
        )
    ]
    register()
    return saved.composed(name, first)


def environment() -> dict[str, str]:
    """The process's own, with one torch thread and without a data folder."""
    return {**os.environ, "OMP_NUM_THREADS": "1", "NNODE_DATA": ""}


def background(
    *command: str, program: Sequence[str] = (sys.executable, "scripts/train.py"), **env: str
) -> subprocess.Popen[str]:
    """A process in the background, by default a training, whose streams can be read."""
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
    """What runs scripts without seconds of imports."""
    processes = Forks(ROOT, environment())
    yield processes
    processes.close()


@pytest.fixture(scope="session")
def script(forks: Forks) -> Script:
    """Run ``scripts/<name>.py`` with overrides, as a user does, in a process that is forked.

    The exit status must be ``status``, 0 by default; None allows any.
    """
    return forks.run


def trained_idm(script: Script, folder: Path, data: pd.DataFrame, *overrides: str) -> Path:
    """The folder of a training of the IDM on a table."""
    data.to_csv(folder / "mine.csv", index=False)
    script(
        "train",
        "model=idm",
        "data=table",
        "data.domain=traffic",
        f"data.path={folder}/mine.csv",
        *overrides,
        f"hydra.run.dir={folder}/run",
    )
    return folder / "run"


@pytest.fixture(scope="session")
def idm_run(script: Script, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a short training of vehicles that follow the model exactly."""
    folder = tmp_path_factory.mktemp("idm")
    return trained_idm(
        script, folder, table(10, 10.0), "trainer.max_epochs=2", "trainer.drivers=none"
    )
