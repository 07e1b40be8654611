"""Scripts run in processes forked from a server that has already imported the libraries.

This file is also the server's program. Each line of JSON on its standard input starts a script or
waits for one; the answer is a process number or an exit status. The server runs no script itself.
Its children therefore inherit no thread, no compiled code and no random state.
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

#: Modules that scripts import.
LOADED = (
    "matplotlib.pyplot",
    "scipy.optimize",
    "torch.utils.tensorboard",
    *(f"nnode.app.{name}" for name in ("discover", "drive", "evaluate", "export")),
    *(f"nnode.app.{name}" for name in ("forces", "prepare", "train")),
    "studies.command",
    # imported by the first optimiser, unit, table and command
    *("torch._dynamo", "torch.distributed.nn", "sympy", "pint", "pyarrow.parquet"),
    *("nnode.app.cli.run", "nnode.app.commands.discover", "nnode.app.commands.train"),
)


class Forked:
    """A process with a part of the interface of ``subprocess.Popen``."""

    def __init__(self, forks: Forks, pid: int, order: dict[str, Any]) -> None:
        self.pid, self.returncode = pid, None
        self._forks, self._order = forks, order

    def poll(self, seconds: float = 0.0) -> int | None:
        """The exit status; None if the process still runs after ``seconds``."""
        if self.returncode is None:
            self.returncode = self._forks.ask({"pid": self.pid, "seconds": seconds})
        return self.returncode

    def send_signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def communicate(self, timeout: float = 1500.0) -> tuple[str, str]:
        """Standard output and errors after the end; the process is killed after ``timeout``."""
        if self.poll(timeout) is None:
            self.send_signal(signal.SIGKILL)
            self.poll(60.0)
        out, errors = (Path(self._order[name]).read_text() for name in ("out", "errors"))
        return out, errors


class Forks:
    """Runs ``scripts/<name>.py``; the first script starts the server.

    Args:
        root: the checkout, which is the working directory.
        environment: of all processes.
    """

    def __init__(self, root: Path, environment: dict[str, str]) -> None:
        self._root, self._environment = root, environment
        self._server: subprocess.Popen[str] | None = None
        self._folder = tempfile.TemporaryDirectory(prefix="forked-")
        self._number = 0

    def run(
        self,
        name: str,
        *overrides: str,
        folder: Path | None = None,
        status: int | None = 0,
        **env: str,
    ) -> subprocess.CompletedProcess[str]:
        """As ``subprocess.run`` with captured text; checks the exit status unless it is None.

        Args:
            folder: the folder of the run.
        """
        run_folder = () if folder is None else (f"hydra.run.dir={folder}",)
        process = self.start(name, *overrides, *run_folder, **env)
        out, errors = process.communicate()
        assert status in (None, process.returncode), out + errors
        return subprocess.CompletedProcess(name, process.returncode or 0, out, errors)

    def start(self, name: str, *overrides: str, **env: str) -> Forked:
        """As ``subprocess.Popen``. A ``name`` with line breaks is code instead of a script."""
        self._number += 1
        order = {
            "name": name,
            "overrides": overrides,
            "env": {**self._environment, **env},
            **{kind: f"{self._folder.name}/{self._number}.{kind}" for kind in ("out", "errors")},
        }
        return Forked(self, self.ask(order), order)

    def ask(self, order: dict[str, Any]) -> Any:
        """The server's answer to an order."""
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
        """End the server."""
        if self._server is not None:
            self._server.communicate()
        self._folder.cleanup()


def run_child(order: dict[str, Any]) -> None:
    """Run an order's script with the order's environment and streams."""
    os.environ.clear()
    os.environ.update(order["env"])
    descriptor = os.open(order["errors"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    os.dup2(descriptor, 2)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    # a forking script replaces these files; the descriptors must stay open
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

    composed("train")  # fills Hydra's caches
    gc.collect()
    gc.freeze()
    children: dict[int, Child] = {}
    for line in sys.stdin:
        order = json.loads(line)
        if "pid" in order:
            answer = children[order["pid"]].status(order["seconds"])
        else:
            child = Child(partial(run_child, order), Path(order["out"]))
            answer, children[child.pid] = child.pid, child
        print(json.dumps(answer), flush=True)
    for child in children.values():
        child.kill()


if __name__ == "__main__":
    main()
