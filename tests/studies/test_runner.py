"""Tasks here, in other processes and on a Dask cluster: kept, interrupted, killed, failing."""

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


def squares(folder: Path, *values: float) -> list[Task]:
    log = str(folder / "calls")
    return [Task(f"square-{x:g}", work.square, {"x": x, "log": log}) for x in values]


def calls(folder: Path) -> list[str]:
    return (folder / "calls").read_text().split()


def eventually(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def gone(pid: int) -> bool:
    """Whether a process has ended, or is only waited for."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


def test_kept_results_are_those_of_one_function_and_fingerprint(tmp_path: Path) -> None:
    run_tasks(squares(tmp_path, 3.0), tmp_path, workers=1, fingerprint="f")
    run_tasks(squares(tmp_path, 1.0), tmp_path, workers=1, fingerprint="f")
    run_tasks(squares(tmp_path, 2.0), tmp_path, workers=1, fingerprint="g")
    cubes = [Task("cube-1", work.cube, {"x": 1.0, "log": str(tmp_path / "calls")})]
    run_tasks(cubes, tmp_path, workers=1, fingerprint="f")
    (tmp_path / "tasks" / "broken.json").write_text("{")
    outcome = kept_results(tmp_path, work.square, "f")
    assert outcome == {"square-1": {"y": 1.0}, "square-3": {"y": 9.0}}


@pytest.fixture
def threads() -> Iterator[int]:
    """Two threads of torch's, whatever the tests are run with."""
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
    """Options of the runner: this process, others, or the workers of a cluster."""
    if request.param == "cluster":
        return {"workers": 1, "cluster": request.getfixturevalue("scheduler")}
    return {"workers": 1 if request.param == "here" else 2}


@pytest.mark.thorough
def test_results_are_the_same_wherever_tasks_run(
    where: dict[str, Any], tmp_path: Path, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", str(threads))
    todo = [*squares(tmp_path, 3.0, 1.0, 2.0), Task("conditions", work.conditions, {})]
    outcome = run_tasks(todo, tmp_path, fingerprint="f", **where)
    assert list(outcome) == ["square-3", "square-1", "square-2", "conditions"]
    assert [outcome[task.key].get("y") for task in todo] == [9.0, 1.0, 4.0, None]
    nan, *others = outcome["conditions"]["values"]
    assert math.isnan(nan)
    assert others == [math.inf, -0.1, 1e-300]
    assert outcome["conditions"]["text"] == "κ"
    assert outcome["conditions"]["threads"] == 1
    assert (outcome["conditions"]["process"] == os.getpid()) == (where == {"workers": 1})
    if where["workers"] > 1:
        assert outcome["conditions"]["blas"] == "1"
    assert torch.get_num_threads() == threads
    # nothing is computed twice, here or elsewhere
    repeated = run_tasks(todo, tmp_path, workers=1, fingerprint="f")
    assert json.dumps(repeated) == json.dumps(outcome)
    assert len(calls(tmp_path)) == 3


def test_what_was_kept_holds_only_for_the_same_task(tmp_path: Path, monkeypatch) -> None:
    def run(*todo: Task, fingerprint: str = "f") -> dict[str, float]:
        (tmp_path / "calls").write_text("")
        outcome = run_tasks(list(todo), tmp_path, workers=1, fingerprint=fingerprint)
        return {key: result["y"] for key, result in outcome.items()}

    log = {"log": str(tmp_path / "calls")}
    run(*squares(tmp_path, 1.0, 2.0, 3.0))
    other = Task("square-2", work.square, {"x": 5.0, **log}, cost=7.0)
    one, _, three = squares(tmp_path, 1.0, 2.0, 3.0)
    assert run(one, other, three) == {"square-1": 1.0, "square-2": 25.0, "square-3": 9.0}
    assert calls(tmp_path) == ["5"]
    assert run(Task("square-2", work.square, {**log, "x": 5.0}, cost=1.0)) == {"square-2": 25.0}
    assert calls(tmp_path) == []
    assert run(Task("square-2", work.cube, {"x": 5.0, **log})) == {"square-2": 125.0}
    assert run(one, three, fingerprint="other data") == {"square-1": 1.0, "square-3": 9.0}
    assert calls(tmp_path) == ["1", "3"]
    monkeypatch.setattr(runner, "VERSION", "99")
    run(one, fingerprint="other data")
    assert calls(tmp_path) == ["1"]


@pytest.mark.parametrize("text", ["", "{", "[]", '{"result": {}}', "\xff"])
def test_a_damaged_result_is_computed_again(text: str, tmp_path: Path, caplog) -> None:
    todo = squares(tmp_path, 2.0)
    run_tasks(todo, tmp_path, workers=1, fingerprint="f")
    (tmp_path / "tasks" / "square-2.json").write_text(text, encoding="latin-1")
    outcome = run_tasks(todo, tmp_path, workers=1, fingerprint="f")
    assert outcome == {"square-2": {"y": 4.0}}
    assert "square-2.json is damaged" in caplog.text
    assert calls(tmp_path) == ["2", "2"]


@pytest.mark.thorough
def test_failing_tasks_let_the_others_finish(where: dict[str, Any], tmp_path: Path) -> None:
    workers = where["workers"]
    kinds = ["data", "python", "list", "object"] + ["exit", "killed"] * (workers > 1)
    bad = [Task(kind, work.fail, {"kind": kind}, cost=2.0) for kind in kinds]
    good = squares(tmp_path, 1.0, 2.0)
    with pytest.raises(StudyError) as caught:
        run_tasks(bad + good, tmp_path, fingerprint="f", **where)
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
        run_tasks([bad[1], *good], tmp_path, workers=1, fingerprint="f")
    assert sorted(calls(tmp_path)) == ["1", "2"]
    # a task that succeeds takes its trace away
    repaired = Task("python", work.square, good[0].arguments)
    run_tasks([repaired], tmp_path, workers=1, fingerprint="f")
    assert not (tmp_path / "tasks" / "python.error.txt").exists()


def start(folder: Path, workers: int) -> subprocess.Popen[str]:
    code = "import sys; from pathlib import Path; from tests.studies.work import study; "
    code += "study(Path(sys.argv[1]), int(sys.argv[2]))"
    command = [sys.executable, "-c", code, str(folder), str(workers)]
    return subprocess.Popen(
        command, cwd=ROOT, stderr=subprocess.PIPE, text=True, start_new_session=True
    )


@pytest.mark.parametrize(("workers", "number"), [(1, signal.SIGTERM), (2, signal.SIGINT)])
def test_an_interrupted_study_goes_on_where_it_stopped(
    workers: int, number: signal.Signals, tmp_path: Path
) -> None:
    signs = [tmp_path / f"sign-{name}" for name in "ab"[:workers]]
    process = start(tmp_path, workers)
    eventually(lambda: all(sign.exists() and sign.read_text() for sign in signs))
    if number == signal.SIGINT:
        # as a terminal does, to all processes
        os.killpg(process.pid, number)
    else:
        process.send_signal(number)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 128 + number, errors
    assert errors.startswith(f"stopped by {number.name}: 2 of 4 tasks are kept in")
    assert "Traceback" not in errors
    eventually(lambda: all(gone(int(sign.read_text())) for sign in signs))
    assert {p.name for p in (tmp_path / "tasks").iterdir()} == {"quick-1.json", "quick-2.json"}
    (tmp_path / "awake").write_text("")
    outcome = run_tasks(work.tasks(tmp_path), tmp_path, workers=1, fingerprint="f")
    assert len(outcome) == 4
    assert sorted(calls(tmp_path)) == ["1", "2"]


def test_a_request_to_stop_waits_for_no_task_of_a_cluster(scheduler: str, tmp_path: Path) -> None:
    tasks = [Task("sleep", work.sleep, {"folder": str(tmp_path), "name": "a"})]

    def stop() -> None:
        eventually((tmp_path / "sign-a").exists)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=stop, daemon=True).start()
    start = time.monotonic()
    with pytest.raises(Interrupted, match="0 of 1 tasks"):
        run_tasks(tasks, tmp_path, workers=1, fingerprint="f", cluster=scheduler)
    assert time.monotonic() - start < 30


@pytest.mark.thorough
def test_nobody_at_the_address_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("studies.workers.ANSWER", 0.5)
    tasks = [Task("where", work.conditions, {})]
    with pytest.raises(ConfigError, match="no scheduler answers"):
        run_tasks(tasks, tmp_path, workers=1, fingerprint="f", cluster="tcp://127.0.0.1:9")


@pytest.mark.slow
def test_workers_leave_with_the_process_that_started_them(tmp_path: Path) -> None:
    signs = [tmp_path / "sign-a", tmp_path / "sign-b"]
    process = start(tmp_path, 2)
    eventually(lambda: all(sign.exists() and sign.read_text() for sign in signs))
    process.kill()
    process.communicate(timeout=30)
    eventually(lambda: all(gone(int(sign.read_text())) for sign in signs))


@pytest.mark.slow
def test_several_processes_may_compile_at_once(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("NNODE_CACHE", str(tmp_path / "cache"))
    todo = [Task(f"simulate-{i}", work.simulate, {"law": "lin"}) for i in range(2)]
    outcome = run_tasks(todo, tmp_path, workers=2, fingerprint="f")
    assert list((tmp_path / "cache").rglob("*.nbi"))
    problem = pose(Shape("traffic", ("lin",), 3, 3, 2, 10, 0.02), "lin", torch.float64)
    exact = TorchdiffeqSolver("euler", "discrete", 0.02)(problem.system, problem.batch).x[-1]
    for result in outcome.values():
        np.testing.assert_allclose(result["x"], exact.detach(), rtol=1e-12)


def test_progress_is_told_in_lines(tmp_path: Path, monkeypatch, caplog) -> None:
    monkeypatch.setattr(progress, "LINE_EVERY", 0.0)
    caplog.set_level(logging.INFO)
    todo = squares(tmp_path, 1.0, 2.0, 3.0)
    run_tasks(todo[:1], tmp_path, workers=1, fingerprint="f")
    caplog.clear()
    run_tasks(todo, tmp_path, workers=1, fingerprint="f", title="squares")
    assert caplog.messages[0].startswith("squares: 2 of 3 tasks, ")
    assert caplog.messages[0].endswith(" s left")
    assert caplog.messages[-1].startswith("squares: 3 tasks, 1 of them kept before, ")


def test_results_that_cannot_be_written_are_an_error_in_words(tmp_path: Path) -> None:
    (tmp_path / "study").write_text("a file where a folder should be")
    with pytest.raises(StudyError, match=r"task square-2 cannot be kept in .*study/tasks"):
        run_tasks(squares(tmp_path, 2.0), tmp_path / "study", workers=1, fingerprint="f")


def test_tasks_that_cannot_work_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="usable as a file name"):
        Task("a/b", work.conditions, {})
    twice = [Task(key, work.conditions, {}) for key in ("a", "A")]
    with pytest.raises(ValueError, match="several tasks have the key a"):
        run_tasks(twice, tmp_path, workers=1, fingerprint="f")
    with pytest.raises(ValueError, match="workers=0"):
        run_tasks([], tmp_path, workers=0, fingerprint="f")
    assert run_tasks([], tmp_path, workers=2, fingerprint="f") == {}
