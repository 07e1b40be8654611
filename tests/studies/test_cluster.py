"""Tasks on a Dask cluster of this machine."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from nnode.calibrate.interrupt import Interrupted
from nnode.errors import ConfigError, StudyError
from studies.runner import Task, run_tasks
from tests.studies import work

distributed = pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, host="127.0.0.1"
    )
    with cluster:
        yield str(cluster.scheduler_address)


@pytest.mark.thorough
def test_tasks_run_in_its_workers_and_are_kept(scheduler: str, tmp_path: Path) -> None:
    log = str(tmp_path / "calls")
    tasks: list[Task] = [
        Task(f"square-{x:g}", work.square, {"x": x, "log": log}) for x in (1.0, 2.0, 3.0)
    ]
    tasks.append(Task("where", work.conditions, {}))
    found = run_tasks(tasks, tmp_path, workers=1, fingerprint="f", cluster=scheduler)
    assert [found[f"square-{x}"]["y"] for x in (1, 2, 3)] == [1.0, 4.0, 9.0]
    assert found["where"]["process"] != os.getpid()
    assert found["where"]["threads"] == 1
    # none is run again, here or there
    assert run_tasks(tasks, tmp_path, workers=1, fingerprint="f") == found
    assert len((tmp_path / "calls").read_text().split()) == 3


def test_a_failure_there_says_why_and_loses_no_other(scheduler: str, tmp_path: Path) -> None:
    log = str(tmp_path / "calls")
    tasks = [
        Task("wrong", work.fail, {"kind": "data"}),
        Task("right", work.square, {"x": 2.0, "log": log}),
    ]
    with pytest.raises(StudyError, match="no rows"):
        run_tasks(tasks, tmp_path, workers=1, fingerprint="f", cluster=scheduler)
    assert (tmp_path / "tasks" / "right.json").exists()


def test_a_request_to_stop_waits_for_no_task(scheduler: str, tmp_path: Path) -> None:
    tasks = [Task("sleep", work.sleep, {"folder": str(tmp_path), "name": "a"})]

    def stop() -> None:
        while not list(tmp_path.glob("*a*")):
            time.sleep(0.05)
        os.kill(os.getpid(), 15)

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
