"""Scripts in processes forked from one that has loaded the libraries: no seconds of imports each.

This file is also the program of that process: it is asked on its standard input, a line of JSON
for scripts to run at a time, and answers with their exit statuses. It is started afresh and never
works itself, so that no thread, no compiled code and no random state is inherited.
"""

from __future__ import annotations

import gc
import importlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.torture.child import Child, script

ROOT = Path(__file__).resolve().parents[2]
#: What scripts use of the libraries and of the package.
LOADED = (
    "matplotlib.pyplot",
    "scipy.optimize",
    "torch.utils.tensorboard",
    *(f"nnode.app.{name}" for name in ("discover", "evaluate", "export", "forces", "prepare")),
    *(f"nnode.app.{name}" for name in ("study", "train")),
)


class Forks:
    """Runs ``scripts/<name>.py``; the process it forks from is started with the first of them.

    Args:
        environment: of the processes.
    """

    def __init__(self, environment: dict[str, str]) -> None:
        self._environment = environment
        self._server: subprocess.Popen[str] | None = None

    def run(self, name: str, *overrides: str, **env: str) -> subprocess.CompletedProcess[str]:
        """As ``subprocess.run`` with captured text."""
        return self.together(name, overrides, [env])[0]

    def together(
        self, name: str, overrides: Sequence[str], envs: list[dict[str, str]]
    ) -> list[subprocess.CompletedProcess[str]]:
        """One script in several processes at a time, each with variables of its own."""
        if self._server is None:
            self._server = subprocess.Popen(
                [sys.executable, "-m", "tests.app.forked"],
                cwd=ROOT, env=self._environment, text=True,
                stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            )  # fmt: skip
        asked, answers = self._server.stdin, self._server.stdout
        assert asked is not None
        assert answers is not None
        with tempfile.TemporaryDirectory() as folder:
            orders = [
                {
                    "name": name, "overrides": overrides, "env": {**self._environment, **env},
                    "out": f"{folder}/out{i}", "errors": f"{folder}/errors{i}",
                }
                for i, env in enumerate(envs)
            ]  # fmt: skip
            print(json.dumps(orders), file=asked, flush=True)
            statuses = json.loads(answers.readline())
            said = [[Path(order[k]).read_text() for k in ("out", "errors")] for order in orders]
        return [
            subprocess.CompletedProcess([name, *overrides], status, *words)
            for status, words in zip(statuses, said, strict=True)
        ]

    def close(self) -> None:
        """End the process that was forked from."""
        if self._server is not None:
            self._server.communicate()


def typed(order: dict[str, Any]) -> None:
    """What a child does; its environment and streams are those of the order."""
    os.environ.clear()
    os.environ.update(order["env"])
    descriptor = os.open(order["errors"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    os.dup2(descriptor, 2)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    sys.stdin, sys.stdout, sys.stderr = open(0), open(1, "w"), open(2, "w")  # noqa: SIM115
    script(ROOT, order["name"], list(order["overrides"]))


def main() -> None:
    for module in LOADED:
        importlib.import_module(module)
    from nnode.app.cli.run import check_overrides
    from nnode.config import register

    register()
    check_overrides([], ROOT / "conf", "train")  # the children share what Hydra looks up once
    gc.collect()
    gc.freeze()
    for line in sys.stdin:
        children = [Child(partial(typed, order), Path(order["out"])) for order in json.loads(line)]
        for child in children:
            child.status(600)
        for child in children:
            child.kill()  # one that still works
        print(json.dumps([child.status() for child in children]), flush=True)


if __name__ == "__main__":
    main()
