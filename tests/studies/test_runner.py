"""Tasks in this process, in worker processes and on a Dask cluster."""

from __future__ import annotations

import json
import logging
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.speed.problems import Shape, pose
from nnode import progress
from nnode.calibrate.interrupt import Interrupted
from nnode.errors import ConfigError, StudyError
from nnode.simulation import TorchdiffeqSolver
from studies import runner
from studies.runner import Task, kept_results, run_tasks
from tests.app.conftest import ROOT
from tests.studies import work


def run(tasks: list[Task], folder: Path, **options: Any) -> dict[str, Any]:
    return run_tasks(tasks, folder, **{"workers": 1, "fingerprint": "f", **options})


def squares(folder: Path, *values: float) -> list[Task]:
    log = str(folder / "calls")
    return [Task(f"square-{x:g}", work.square, {"x": x, "log": log}) for x in values]


def calls(folder: Path) -> list[str]:
    return (folder / "calls").read_text().split()


def wait_until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < end, "timeout"
        time.sleep(0.02)


def ended(pid: int) -> bool:
    """Whether a process has ended, possibly as a zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


def test_kept_results_of_a_function_and_fingerprint(tmp_path: Path) -> None:
    run(squares(tmp_path, 3.0), tmp_path)
    run(squares(tmp_path, 1.0), tmp_path)
    run(squares(tmp_path, 2.0), tmp_path, fingerprint="g")
    cubes = [Task("cube-1", work.cube, {"x": 1.0, "log": str(tmp_path / "calls")})]
    run(cubes, tmp_path)
    (tmp_path / "tasks" / "broken.json").write_text("{")
    outcome = kept_results(tmp_path, work.square, "f")
    assert outcome == {"square-1": {"y": 1.0}, "square-3": {"y": 9.0}}


@pytest.fixture
def threads() -> Iterator[int]:
    """Set torch to two threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield 2
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    """The address of a Dask cluster on this machine."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, host="127.0.0.1"
    ) as cluster:
        yield str(cluster.scheduler_address)


@pytest.fixture(params=["here", "processes", "cluster"])
def where(request: pytest.FixtureRequest) -> dict[str, Any]:
    """Options of the runner: this process, worker processes or a cluster."""
    if request.param == "cluster":
        return {"workers": 1, "cluster": request.getfixturevalue("scheduler")}
    return {"workers": 1 if request.param == "here" else 2}


@pytest.mark.thorough
def test_results_do_not_depend_on_where_tasks_run(
    where: dict[str, Any], tmp_path: Path, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", str(threads))
    tasks = [*squares(tmp_path, 3.0, 1.0, 2.0), Task("conditions", work.conditions, {})]
    outcome = run(tasks, tmp_path, **where)
    assert list(outcome) == ["square-3", "square-1", "square-2", "conditions"]
    assert [outcome[task.key].get("y") for task in tasks] == [9.0, 1.0, 4.0, None]
    conditions = outcome["conditions"]
    assert conditions["values"] == pytest.approx(
        [math.nan, math.inf, -0.1, 1e-300], rel=0, abs=0, nan_ok=True
    )
    assert (conditions["text"], conditions["threads"]) == ("κ", 1)
    assert (conditions["process"] == os.getpid()) == (where == {"workers": 1})
    if where["workers"] > 1:
        assert conditions["blas"] == "1"
    assert torch.get_num_threads() == threads
    # no task is computed twice
    repeated = run(tasks, tmp_path)
    assert json.dumps(repeated) == json.dumps(outcome)
    assert len(calls(tmp_path)) == 3


def test_kept_results_are_used_for_the_same_task_only(tmp_path: Path, monkeypatch) -> None:
    def computed(*tasks: Task, expected: list[float], fingerprint: str = "f") -> list[str]:
        """The calls of a run with these results."""
        (tmp_path / "calls").write_text("")
        outcome = run(list(tasks), tmp_path, fingerprint=fingerprint)
        assert [result["y"] for result in outcome.values()] == expected
        return calls(tmp_path)

    log = {"log": str(tmp_path / "calls")}
    first, second, third = squares(tmp_path, 1.0, 2.0, 3.0)
    computed(first, second, third, expected=[1.0, 4.0, 9.0])
    other = Task("square-2", work.square, {"x": 5.0, **log}, cost=7.0)
    assert computed(first, other, third, expected=[1.0, 25.0, 9.0]) == ["5"]
    # neither the order of arguments nor the cost matters
    same = Task("square-2", work.square, {**log, "x": 5.0}, cost=1.0)
    assert computed(same, expected=[25.0]) == []
    computed(Task("square-2", work.cube, {"x": 5.0, **log}), expected=[125.0])
    assert computed(first, third, expected=[1.0, 9.0], fingerprint="other") == ["1", "3"]
    monkeypatch.setattr(runner, "VERSION", "99")
    assert computed(first, expected=[1.0], fingerprint="other") == ["1"]


@pytest.mark.parametrize("text", ["", "{", "[]", '{"result": {}}', "\xff"])
def test_damaged_result_is_computed_again(text: str, tmp_path: Path, caplog) -> None:
    tasks = squares(tmp_path, 2.0)
    run(tasks, tmp_path)
    (tmp_path / "tasks" / "square-2.json").write_text(text, encoding="latin-1")
    assert run(tasks, tmp_path) == {"square-2": {"y": 4.0}}
    assert "square-2.json is damaged" in caplog.text
    assert calls(tmp_path) == ["2", "2"]


@pytest.mark.thorough
def test_failing_tasks_do_not_stop_the_others(where: dict[str, Any], tmp_path: Path) -> None:
    workers = where["workers"]
    kinds = ["data", "python", "list", "object"] + ["exit", "killed"] * (workers > 1)
    bad = [Task(kind, work.fail, {"kind": kind}, cost=2.0) for kind in kinds]
    good = squares(tmp_path, 1.0, 2.0)
    with pytest.raises(StudyError) as caught:
        run(bad + good, tmp_path, **where)
    text = str(caught.value)
    assert f"{len(kinds)} of {len(kinds) + 2} tasks failed" in text
    assert "data: recording 7: no rows" in text
    assert "object: TypeError: Object of type object is not JSON" in text
    if workers > 1:
        assert "exit: its process ended by itself with status 3" in text
        assert "killed: its process was ended by signal 9 (SIGKILL)" in text
    assert f"2 results are kept in {tmp_path / 'tasks'}" in text
    kept = {path.name for path in (tmp_path / "tasks").iterdir()}
    traces = {f"{kind}.error.txt" for kind in ("python", "list", "object")}
    assert kept == {"square-1.json", "square-2.json", *traces}
    assert "ZeroDivisionError: by nought" in (tmp_path / "tasks/python.error.txt").read_text()
    with pytest.raises(StudyError, match="1 of 3 tasks failed: python: ZeroDivisionError"):
        run([bad[1], *good], tmp_path)
    assert sorted(calls(tmp_path)) == ["1", "2"]
    # the traceback file is removed when the task succeeds
    repaired = Task("python", work.square, good[0].arguments)
    run([repaired], tmp_path)
    assert not (tmp_path / "tasks" / "python.error.txt").exists()


def start(folder: Path, workers: int) -> tuple[subprocess.Popen[str], list[Path]]:
    """A process that runs the study, with the files of its running tasks' process ids."""
    code = "import sys; from pathlib import Path; from tests.studies.work import study; "
    code += "study(Path(sys.argv[1]), int(sys.argv[2]))"
    command = [sys.executable, "-c", code, str(folder), str(workers)]
    process = subprocess.Popen(
        command, cwd=ROOT, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    signs = [folder / f"sign-{name}" for name in "ab"[:workers]]
    wait_until(lambda: all(sign.exists() and sign.read_text() for sign in signs))
    return process, signs


@pytest.mark.parametrize(("workers", "number"), [(1, signal.SIGTERM), (2, signal.SIGINT)])
def test_interrupted_study_is_resumed(workers: int, number: signal.Signals, tmp_path: Path) -> None:
    process, signs = start(tmp_path, workers)
    if number == signal.SIGINT:
        # to all processes, as a terminal does
        os.killpg(process.pid, number)
    else:
        process.send_signal(number)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 128 + number, errors
    assert errors.startswith(f"stopped by {number.name}: 2 of 4 tasks are kept in")
    assert "Traceback" not in errors
    wait_until(lambda: all(ended(int(sign.read_text())) for sign in signs))
    assert {p.name for p in (tmp_path / "tasks").iterdir()} == {"quick-1.json", "quick-2.json"}
    (tmp_path / "awake").write_text("")
    outcome = run(work.tasks(tmp_path), tmp_path)
    assert len(outcome) == 4
    assert sorted(calls(tmp_path)) == ["1", "2"]


def test_interrupt_does_not_wait_for_tasks_of_a_cluster(scheduler: str, tmp_path: Path) -> None:
    tasks = [Task("sleep", work.sleep, {"folder": str(tmp_path), "name": "a"})]

    def stop() -> None:
        wait_until((tmp_path / "sign-a").exists)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=stop, daemon=True).start()
    start = time.monotonic()
    with pytest.raises(Interrupted, match="0 of 1 tasks"):
        run(tasks, tmp_path, cluster=scheduler)
    assert time.monotonic() - start < 30


@pytest.mark.thorough
def test_missing_scheduler_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("studies.workers.ANSWER", 0.5)
    tasks = [Task("conditions", work.conditions, {})]
    with pytest.raises(ConfigError, match="no scheduler answers"):
        run(tasks, tmp_path, cluster="tcp://127.0.0.1:9")


@pytest.mark.slow
def test_workers_end_with_their_parent(tmp_path: Path) -> None:
    process, signs = start(tmp_path, 2)
    process.kill()
    process.communicate(timeout=30)
    wait_until(lambda: all(ended(int(sign.read_text())) for sign in signs))


@pytest.mark.slow
def test_concurrent_compilation(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("NNODE_CACHE", str(tmp_path / "cache"))
    tasks = [Task(f"simulate-{i}", work.simulate, {"law": "lin"}) for i in range(2)]
    outcome = run(tasks, tmp_path, workers=2)
    assert list((tmp_path / "cache").rglob("*.nbi"))
    problem = pose(Shape("traffic", ("lin",), 3, 3, 2, 10, 0.02), "lin", torch.float64)
    exact = TorchdiffeqSolver("euler", "discrete", 0.02)(problem.system, problem.batch).x[-1]
    for result in outcome.values():
        np.testing.assert_allclose(result["x"], exact.detach(), rtol=1e-12)


def test_progress_is_logged(tmp_path: Path, monkeypatch, caplog) -> None:
    monkeypatch.setattr(progress, "LINE_EVERY", 0.0)
    caplog.set_level(logging.INFO)
    tasks = squares(tmp_path, 1.0, 2.0, 3.0)
    run(tasks[:1], tmp_path)
    caplog.clear()
    run(tasks, tmp_path, title="squares")
    assert caplog.messages[0].startswith("squares: 2 of 3 tasks, ")
    assert caplog.messages[0].endswith(" s left")
    assert caplog.messages[-1].startswith("squares: 3 tasks, 1 of them kept before, ")


def test_unwritable_results_are_reported(tmp_path: Path) -> None:
    (tmp_path / "study").write_text("a file where a folder should be")
    with pytest.raises(StudyError, match=r"task square-2 cannot be kept in .*study/tasks"):
        run(squares(tmp_path, 2.0), tmp_path / "study")


def test_invalid_tasks_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="usable as a file name"):
        Task("a/b", work.conditions, {})
    twice = [Task(key, work.conditions, {}) for key in ("a", "A")]
    with pytest.raises(ValueError, match="several tasks have the key a"):
        run(twice, tmp_path)
    with pytest.raises(ValueError, match="workers=0"):
        run([], tmp_path, workers=0)
    assert run([], tmp_path, workers=2) == {}
