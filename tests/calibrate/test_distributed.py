"""Two processes give what one gives with the same mini-batches."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

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
    """The folder of two processes that have calibrated all cases together."""
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
    # rarely PyTorch aborts while it takes down its threads, after everything has been written
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
    alone = make_trainer(case, store, tmp_path)
    alone.fit()
    expected = numbers(alone)
    assert alone.step >= 8
    start = torch.cat(
        [p.detach().flatten() for p in make_trainer(case, store, tmp_path).model.parameters()]
    )
    moved = (torch.tensor(expected["parameters"]) - start).abs().max()
    assert moved > 1e-2  # otherwise agreement would mean nothing
    for found in processes(together):
        assert found[case]["step"] == alone.step
        assert found[case]["parameters"] == pytest.approx(expected["parameters"], abs=1e-6, rel=0)
        for name in ("train", "heldout", "norms"):
            assert found[case][name] == pytest.approx(expected[name], rel=1e-6)


@pytest.mark.parametrize("case", CASES)
def test_both_processes_hold_the_same_bits(together: Path, case: str) -> None:
    first, second = processes(together)
    assert first[case] == second[case]


def test_the_first_process_alone_writes(together: Path) -> None:
    for case in CASES:
        assert len(list((together / case / "tensorboard").glob("events.*"))) == 2  # and hparams
        files = {p.name for p in (together / case / "checkpoints").iterdir()}
        assert files == {"best.pt", "last.pt"}


def test_an_error_in_one_process_is_raised_in_both(together: Path) -> None:
    for found in processes(together):
        assert found["failing"] == "process 1 lost a car"


def test_a_signal_to_one_process_stops_both_at_the_same_step(
    together: Path, store: Store, tmp_path: Path
) -> None:
    for found in processes(together):
        assert found["interrupted"] == [4, signal.SIGTERM]
    # and one process goes on to the same end
    again = make_trainer("adadelta", store, tmp_path)
    again.restore(together / "interrupted" / "checkpoints" / "last.pt")
    assert again.step == 4
    again.fit()
    expected = processes(together)[0]["adadelta"]
    assert numbers(again)["parameters"] == pytest.approx(expected["parameters"], abs=1e-6, rel=0)


@pytest.mark.parametrize("size", [1, 2, 3, 5])
@pytest.mark.parametrize("batch_size", [0, 1, 3])
def test_shares_make_up_every_mini_batch(size: int, batch_size: int) -> None:
    whole = EpochSampler(11, batch_size, seed=4)
    shares = [EpochSampler(11, batch_size, 4, rank=rank, size=size) for rank in range(size)]
    for sampler in (whole, *shares):
        sampler.set_epoch(2)
        assert len(sampler) == whole.n_batches
    for number, (batch, *parts) in enumerate(zip(whole, *shares, strict=True)):
        assert sorted(i for part in parts for i in part) == sorted(batch)
        assert max(map(len, parts)) - min(map(len, parts)) <= 1
        assert {s.sequences(number) for s in shares} == {len(batch)}


def test_device_is_chosen_and_a_missing_one_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert World().use(Device.auto, "trainer.device") == torch.device("cpu")
    with pytest.raises(ConfigError, match=r"trainer\.device=cuda, but torch finds no CUDA"):
        World().use(Device.cuda, "trainer.device")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "set_device", lambda device: None)
    assert World().use(Device.auto, "trainer.device") == torch.device("cuda", 0)
    assert World().use(Device.cpu, "trainer.device") == torch.device("cpu")
