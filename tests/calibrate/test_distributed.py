"""Calibration by two processes against one process with the same mini-batches."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nnode.calibrate.distributed import World
from nnode.calibrate.options import Device
from nnode.data.dataset import EpochSampler
from nnode.data.store import Store
from nnode.errors import ConfigError
from tests.app.conftest import ROOT, environment
from tests.calibrate.together import CASES, make_trainer, numbers


@pytest.fixture(scope="module")
def together(store: Store, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a joint calibration of all cases by two processes."""
    folder = tmp_path_factory.mktemp("together")
    worker = Path(__file__).with_name("together.py")
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    done = subprocess.run(
        [*command, str(worker), str(store.folder), str(folder)],
        env={**environment(), "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    # PyTorch rarely aborts during thread teardown, after all files are written
    finished = all((folder / f"process_{rank}.json").is_file() for rank in (0, 1))
    teardown = "terminate called without an active exception" in done.stderr
    assert done.returncode == 0 or (finished and teardown), done.stderr
    return folder


def processes(folder: Path) -> list[dict[str, Any]]:
    return [json.loads((folder / f"process_{rank}.json").read_text()) for rank in (0, 1)]


@pytest.mark.thorough
@pytest.mark.parametrize("case", CASES)
def test_two_processes_end_where_one_ends(
    together: Path, store: Store, tmp_path: Path, case: str
) -> None:
    trainer = make_trainer(case, store, tmp_path)
    start = numbers(trainer)["parameters"]
    trainer.fit()
    expected = numbers(trainer)
    assert expected["step"] >= 8
    # otherwise the agreement would be trivial
    assert np.abs(np.subtract(expected["parameters"], start)).max() > 1e-2
    for results in processes(together):
        result = results[case]
        assert result["step"] == expected["step"]
        assert result["parameters"] == pytest.approx(expected["parameters"], abs=1e-6, rel=0)
        for name in ("train", "heldout", "norms"):
            assert result[name] == pytest.approx(expected[name], rel=1e-6)


@pytest.mark.parametrize("case", CASES)
def test_processes_are_bit_identical(together: Path, case: str) -> None:
    first, second = processes(together)
    assert first[case] == second[case]


def test_only_the_first_process_writes(together: Path) -> None:
    for case in CASES:
        assert (
            len(list((together / case / "tensorboard").glob("events.*"))) == 2
        )  # scalars and hparams
        files = {p.name for p in (together / case / "checkpoints").iterdir()}
        assert files == {"best.pt", "last.pt"}


def test_error_in_one_process_is_raised_in_both(together: Path) -> None:
    for results in processes(together):
        assert results["failing"] == "process 1 lost a car"


def test_signal_to_one_process_stops_both_at_the_same_step(
    together: Path, store: Store, tmp_path: Path
) -> None:
    for results in processes(together):
        assert results["interrupted"] == [4, signal.SIGTERM]
    # a single process can resume and reaches the same end
    resumed = make_trainer("adadelta", store, tmp_path)
    resumed.restore(together / "interrupted" / "checkpoints" / "last.pt")
    assert resumed.step == 4
    resumed.fit()
    expected = processes(together)[0]["adadelta"]
    assert numbers(resumed)["parameters"] == pytest.approx(expected["parameters"], abs=1e-6, rel=0)


@pytest.mark.parametrize("size", [1, 2, 3, 5])
@pytest.mark.parametrize("batch_size", [0, 1, 3])
def test_shares_add_up_to_every_mini_batch(size: int, batch_size: int) -> None:
    full = EpochSampler(11, batch_size, seed=4)
    shares = [EpochSampler(11, batch_size, 4, rank=rank, size=size) for rank in range(size)]
    for sampler in (full, *shares):
        sampler.set_epoch(2)
        assert len(sampler) == full.n_batches
    for number, (batch, *parts) in enumerate(zip(full, *shares, strict=True)):
        assert sorted(i for part in parts for i in part) == sorted(batch)
        assert max(map(len, parts)) - min(map(len, parts)) <= 1
        assert {s.sequences(number) for s in shares} == {len(batch)}


def test_device_selection(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert World().use(Device.auto, "trainer.device") == torch.device("cpu")
    with pytest.raises(ConfigError, match=r"trainer\.device=cuda, but torch finds no CUDA"):
        World().use(Device.cuda, "trainer.device")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "set_device", lambda device: None)
    assert World().use(Device.auto, "trainer.device") == torch.device("cuda", 0)
    assert World().use(Device.cpu, "trainer.device") == torch.device("cpu")
