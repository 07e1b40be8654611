"""Scripts in processes forked from one that has loaded the libraries: no seconds of imports each.

This file is also the program of that process: it is asked on its standard input, a line of JSON
for scripts to start at a time or for ones to wait for, and answers with their numbers or their exit
statuses. It is started afresh and never works itself, so that no thread, no compiled code and no
random state is inherited.
"""

from __future__ import annotations

import gc
import importlib
import json
import os
import signal
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.fault_injection.child import Child, script

#: What scripts use of the libraries and of the package.
LOADED = (
    "matplotlib.pyplot",
    "scipy.optimize",
    "torch.utils.tensorboard",
    *(f"nnode.app.{name}" for name in ("discover", "drive", "evaluate", "export")),
    *(f"nnode.app.{name}" for name in ("forces", "prepare", "train")),
    "studies.command",
    # what the first optimiser, unit, table and command load
    *("torch._dynamo", "torch.distributed.nn", "sympy", "pint", "pyarrow.parquet"),
    *("nnode.app.cli.run", "nnode.app.commands.discover", "nnode.app.commands.train"),
)


class Forked:
    """A process, with what is needed of ``subprocess.Popen``."""

    def __init__(self, forks: Forks, pid: int, order: dict[str, Any]) -> None:
        self.pid, self.returncode = pid, None
        self._forks, self._order = forks, order

    def poll(self, seconds: float = 0.0) -> int | None:
        """Its exit status; None where it still works after ``seconds``."""
        if self.returncode is None:
            self.returncode = self._forks.ask({"pid": self.pid, "seconds": seconds})
        return self.returncode

    def send_signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def communicate(self, timeout: float = 1500.0) -> tuple[str, str]:
        """What it printed, at its end; one that works for longer is ended."""
        if self.poll(timeout) is None:
            self.send_signal(signal.SIGKILL)
            self.poll(60.0)
        out, errors = (Path(self._order[name]).read_text() for name in ("out", "errors"))
        return out, errors


class Forks:
    """Runs ``scripts/<name>.py``; the process it forks from is started with the first of them.

    Args:
        root: of the checkout, where the scripts run.
        environment: of the processes.
    """

    def __init__(self, root: Path, environment: dict[str, str]) -> None:
        self._root, self._environment = root, environment
        self._server: subprocess.Popen[str] | None = None
        self._folder = tempfile.TemporaryDirectory(prefix="forked-")
        self._number = 0

    def run(
        self, name: str, *overrides: str, status: int | None = 0, **env: str
    ) -> subprocess.CompletedProcess[str]:
        """As ``subprocess.run`` with captured text.

        The exit status must be ``status``; None allows any.
        """
        process = self.start(name, *overrides, **env)
        out, errors = process.communicate()
        assert status in (None, process.returncode), out + errors
        return subprocess.CompletedProcess(name, process.returncode or 0, out, errors)

    def start(self, name: str, *overrides: str, **env: str) -> Forked:
        """As ``subprocess.Popen``; in place of a script's name may stand code, of several lines."""
        self._number += 1
        order = {
            "name": name,
            "overrides": overrides,
            "env": {**self._environment, **env},
            **{kind: f"{self._folder.name}/{self._number}.{kind}" for kind in ("out", "errors")},
        }
        return Forked(self, self.ask(order), order)

    def ask(self, order: dict[str, Any]) -> Any:
        """What the process that is forked from answers."""
        if self._server is None:
            self._server = subprocess.Popen(
                [sys.executable, "-m", "tests.app.forked"],
                cwd=self._root,
                env=self._environment,
                text=True,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
            )
        assert self._server.stdin is not None
        assert self._server.stdout is not None
        print(json.dumps(order), file=self._server.stdin, flush=True)
        return json.loads(self._server.stdout.readline())

    def close(self) -> None:
        """End the process that was forked from."""
        if self._server is not None:
            self._server.communicate()
        self._folder.cleanup()


def typed(order: dict[str, Any]) -> None:
    """What a child does; its environment and streams are those of the order."""
    os.environ.clear()
    os.environ.update(order["env"])
    descriptor = os.open(order["errors"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    os.dup2(descriptor, 2)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    # a script that forks replaces these files, which must not close the descriptors
    sys.stdin, sys.stdout, sys.stderr = (
        open(number, mode, closefd=False)  # noqa: SIM115
        for number, mode in enumerate(("r", "w", "w"))
    )
    name, overrides = order["name"], list(order["overrides"])
    if "\n" in name:
        sys.argv = ["-c", *overrides]
        exec(name, {"__name__": "__main__"})
    else:
        script(Path.cwd(), name, overrides)


def main() -> None:
    for module in LOADED:
        importlib.import_module(module)
    from tests.app.conftest import composed

    composed("train")  # the children share what Hydra looks up once
    gc.collect()
    gc.freeze()
    children: dict[int, Child] = {}
    for line in sys.stdin:
        order = json.loads(line)
        if "pid" in order:
            answer = children[order["pid"]].status(order["seconds"])
        else:
            child = Child(partial(typed, order), Path(order["out"]))
            answer, children[child.pid] = child.pid, child
        print(json.dumps(answer), flush=True)
    for child in children.values():
        child.kill()  # one that nobody waited for


if __name__ == "__main__":
    main()
