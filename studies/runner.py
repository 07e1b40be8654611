"""Independent tasks, in several processes, each kept as soon as it is done.

A study is many small calibrations and simulations. Each is a task: a function, its arguments and
a name. Its result is a small JSON file, so that a study that was broken off, or that is asked for
again with some options changed, computes only what it has not computed before.
"""

from __future__ import annotations

import json
import logging
import re
import signal
import time
from collections import Counter
from collections.abc import Callable, Generator
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nnode.calibrate.interrupt import Interrupted, InterruptGuard
from nnode.errors import StudyError
from nnode.files import write_json, write_text
from nnode.version import VERSION
from studies.progress import TaskProgress
from studies.workers import Call, Outcome, calls_here, calls_in_processes, calls_on_cluster

log = logging.getLogger(__name__)

#: Folder of the kept results, inside the study's own.
KEPT = "tasks"

_KEY = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,149}")

#: So many failed tasks are named with their errors.
_NAMED = 5


@dataclass(frozen=True)
class Task:
    """One piece of a study.

    Attributes:
        key: unique among the study's tasks; the name of its file.
        function: of a module, so that another process can import it; returns a dict of plain
            JSON (numbers, NaN and infinities included, strings, lists, dicts).
        arguments: keyword arguments, plain JSON as well: they decide whether a kept result
            still holds.
        cost: expected time relative to the other tasks; the dearest start first.
    """

    key: str
    function: Callable[..., dict[str, Any]]
    arguments: dict[str, Any]
    cost: float = 1.0

    def __post_init__(self) -> None:
        if not _KEY.fullmatch(self.key):
            raise ValueError(f"a task's key must be usable as a file name, got {self.key!r}")

    def identity(self, fingerprint: str) -> dict[str, Any]:
        """What a result depends on."""
        return {
            "function": f"{self.function.__module__}.{self.function.__qualname__}",
            "arguments": self.arguments,
            "version": VERSION,
            "fingerprint": fingerprint,
        }

    def call(self) -> Call:
        """The function, and the arguments as JSON gives them back: the same in any process."""
        return self.function, json.loads(json.dumps(self.arguments))


def run_tasks(
    tasks: list[Task],
    folder: Path,
    *,
    workers: int,
    fingerprint: str,
    cluster: str | None = None,
    title: str = "tasks",
) -> dict[str, dict[str, Any]]:
    """The results of all tasks.

    Each finished task is kept at once as ``folder/tasks/<key>.json``. One that was kept with the
    same function, arguments, version of the package and fingerprint is not run again. The first
    SIGINT or SIGTERM breaks off the tasks that are running.

    Args:
        tasks: independent of each other.
        folder: of the study.
        workers: number of processes, each with one thread; 1 works in this process.
        fingerprint: of all that the tasks read beside their arguments, such as the data's hash.
        cluster: address of a Dask scheduler, whose workers do the work instead; or None.
        title: of the progress shown.

    Returns:
        Results by key, in the order of the tasks, as JSON gives them back.

    Raises:
        ConfigError: no scheduler answers at the address of the cluster.
        Interrupted: a signal asked to stop.
        StudyError: tasks failed; all others were finished first. Or results cannot be written.
    """
    twice = [k for k, n in Counter(task.key.casefold() for task in tasks).items() if n > 1]
    if twice:
        raise ValueError(f"several tasks have the key {', '.join(twice)}")
    if workers < 1:
        raise ValueError(f"workers={workers} must be at least 1")
    places = {task.key: folder / KEPT / f"{task.key}.json" for task in tasks}
    identities = {task.key: task.identity(fingerprint) for task in tasks}
    results = {key: _kept(places[key], identities[key]) for key in places}
    missing = sorted((t for t in tasks if results[t.key] is None), key=lambda t: -t.cost)
    costs = {task.key: task.cost for task in missing}
    failed: dict[str, str] = {}
    start, before = time.monotonic(), len(tasks) - len(missing)
    progress = TaskProgress(title, len(tasks), before, sum(costs.values()))
    calls = [(task.key, task.call()) for task in missing]
    with (
        InterruptGuard() as guard,
        progress,
        closing(_outcomes(calls, workers, cluster, guard, progress.tick)) as outcomes,
    ):
        for key, outcome in outcomes:
            try:
                if outcome.text is None:
                    failed[key] = _failure(outcome, places[key])
                else:
                    results[key] = _keep(outcome, places[key], identities[key])
            except OSError as error:
                raise StudyError(
                    f"the result of task {key} cannot be kept in {folder / KEPT}: "
                    f"{error.strerror}; make room or choose another folder, and start again"
                ) from error
            progress.advance(costs[key])
    done = sum(result is not None for result in results.values())
    if guard.requested is not None:
        raise Interrupted(
            f"stopped by {signal.Signals(guard.requested).name}: {done} of {len(tasks)} tasks are "
            f"kept in {folder / KEPT}; the same command goes on from there",
            guard.requested,
        )
    if failed:
        raise StudyError(_failures(failed, done, len(tasks), folder))
    passed = time.monotonic() - start
    log.info("%s: %d tasks, %d of them kept before, %.1f s", title, len(tasks), before, passed)
    return {key: result for key, result in results.items() if result is not None}


def _outcomes(
    calls: list[tuple[str, Call]],
    workers: int,
    cluster: str | None,
    guard: InterruptGuard,
    tick: Callable[[], None],
) -> Generator[tuple[str, Outcome], None, None]:
    """The calls' outcomes as they come, from a cluster, this process or others."""
    if cluster is not None:
        return calls_on_cluster(calls, cluster, guard, tick)
    if workers == 1:
        return calls_here(calls, guard)
    return calls_in_processes(calls, workers, guard, tick)


def kept_results(
    folder: Path, function: Callable[..., dict[str, Any]], fingerprint: str
) -> dict[str, dict[str, Any]]:
    """Results by key of all tasks of a function that a folder holds and that still hold.

    Args:
        folder: of the study.
        function: of the tasks.
        fingerprint: as in :func:`run_tasks`.
    """
    results = {}
    for path in sorted((folder / KEPT).glob("*.json")):
        with suppress(OSError, ValueError, KeyError, TypeError):
            arguments = json.loads(path.read_text(encoding="utf-8"))["identity"]["arguments"]
            task = Task(path.stem, function, arguments)
            result = _kept(path, task.identity(fingerprint))
            if result is not None:
                results[task.key] = result
    return results


def _kept(path: Path, identity: dict[str, Any]) -> dict[str, Any] | None:
    """A kept result, if it is of the same task."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        # as text, NaN equals itself
        kept, asked = (json.dumps(each, sort_keys=True) for each in (content["identity"], identity))
        return dict(content["result"]) if kept == asked else None
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        log.warning("%s is damaged (%s) and is computed again", path, type(error).__name__)
        return None


def _keep(outcome: Outcome, path: Path, identity: dict[str, Any]) -> dict[str, Any]:
    assert outcome.text is not None
    result: dict[str, Any] = json.loads(outcome.text)
    content = {"identity": identity, "seconds": outcome.seconds, "result": result}
    write_json(path, content, indent=None)
    _trace_file(path).unlink(missing_ok=True)
    return result


def _trace_file(path: Path) -> Path:
    return path.with_suffix(".error.txt")


def _failure(outcome: Outcome, path: Path) -> str:
    """Why a task failed; where it failed is written beside the results."""
    if not outcome.trace:
        return outcome.error
    return f"{outcome.error} (see {write_text(_trace_file(path), outcome.trace).name})"


def _failures(failed: dict[str, str], done: int, total: int, folder: Path) -> str:
    named = [f"{key}: {why}" for key, why in sorted(failed.items())[:_NAMED]]
    unnamed = [f"and {len(failed) - _NAMED} more"] if len(failed) > _NAMED else []
    return (
        f"{len(failed)} of {total} tasks failed: {'; '.join(named + unnamed)}. {done} results are "
        f"kept in {folder / KEPT}; the same command runs only the failed ones again"
    )
