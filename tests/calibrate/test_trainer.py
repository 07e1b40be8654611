"""The training loop: progress, projection, early stopping and bit-identical resuming."""

from __future__ import annotations

import os
import random
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from nnode.calibrate.checkpoint import load_checkpoint
from nnode.calibrate.interrupt import Interrupted
from nnode.calibrate.optimizers import (
    AdadeltaOptions,
    AdamOptions,
    LbfgsOptions,
    OptimizerOptions,
)
from nnode.calibrate.trainer import Trainer
from nnode.data.sequence import Batch
from nnode.errors import SimulationError
from nnode.model import System
from nnode.simulation import FusedSolver, Trajectory

Make = Callable[..., Trainer]

OPTIMIZERS: list[tuple[OptimizerOptions, int]] = [
    (AdadeltaOptions(), 2),
    (AdamOptions(), 2),
    (LbfgsOptions(max_iter=3), 0),
]


def stop_after(trainer: Trainer, steps: int, number: int = signal.SIGTERM) -> None:
    """Send a signal to this process after ``steps`` further steps."""
    descend, left = trainer._descend, [steps]

    def counted(batch: object) -> None:
        descend(batch)
        left[0] -= 1
        if left[0] == 0:
            os.kill(os.getpid(), number)

    trainer._descend = counted


def parameters(trainer: Trainer) -> list[torch.Tensor]:
    return [p.detach().clone() for p in trainer.model.parameters()]


def identical(a: list[torch.Tensor], b: list[torch.Tensor]) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def resumed(trainer: Trainer, checkpoint: Path) -> Trainer:
    """The trainer after it has continued from a checkpoint to the last epoch."""
    trainer.restore(checkpoint)
    trainer.fit()
    return trainer


def test_training_recovers_the_law(make_trainer: Make, tmp_path: Path) -> None:
    optimizer, solver = AdamOptions(lr=0.3), FusedSolver(0.02)
    trainer = make_trainer(tmp_path, optimizer, solver=solver, max_epochs=50, evaluate_every=50)
    trainer.fit()
    first, last = trainer.history[0], trainer.history[-1]
    assert last["cost/train"] < 1e-3 * first["cost/train"]
    assert last["cost/heldout"] < 1e-2 * first["cost/heldout"]
    # the steps are 0.002 s in the data and 0.02 s in the model
    assert last["parameters/lin.v0"] == pytest.approx(22, abs=0.1)
    assert last["parameters/lin.L"] == pytest.approx(4, abs=0.1)


def test_parameters_stay_within_bounds(make_trainer: Make, tmp_path: Path) -> None:
    trainer = make_trainer(tmp_path, AdamOptions(lr=3.0), max_epochs=8)
    trainer.fit()
    lengths = [row["parameters/lin.L"] for row in trainer.history]
    assert min(lengths) >= 2.0
    assert 2.0 in lengths  # the bound was reached


def test_best_checkpoint_has_the_lowest_cost(make_trainer: Make, tmp_path: Path) -> None:
    # without momentum, steps of 1 m/s oscillate around the minimum
    trainer = make_trainer(tmp_path, AdamOptions(lr=1.0, beta1=0.0), max_epochs=40)
    trainer.fit()
    costs = [row["cost/train"] for row in trainer.history]
    best = load_checkpoint(trainer.best_path)
    assert best.history[-1]["cost/train"] == min(costs)
    v0 = float(best.build().physical()["lin.v0"][0])
    assert v0 == best.history[-1]["parameters/lin.v0"]
    assert costs[-1] > min(costs)  # the last checkpoint is not the best


@pytest.mark.parametrize(
    ("options", "epochs"),
    [
        # the first evaluation is an improvement, the next three are not
        ({"max_epochs": 50, "patience": 3, "min_delta": 1e6}, [0, 1, 2, 3]),
        ({"max_epochs": 5, "evaluate_every": 2}, [0, 2, 4, 5]),
    ],
    ids=["patience", "evaluate_every"],
)
def test_evaluated_epochs(
    make_trainer: Make, tmp_path: Path, options: dict[str, float], epochs: list[int]
) -> None:
    trainer = make_trainer(tmp_path, **options)
    trainer.fit()
    assert [row["epoch"] for row in trainer.history] == epochs


@pytest.mark.parametrize(("options", "size"), OPTIMIZERS, ids=lambda v: getattr(v, "name", ""))
def test_resume_after_ten_interruptions_is_bit_identical(
    make_trainer: Make, tmp_path: Path, options: OptimizerOptions, size: int
) -> None:
    expected = make_trainer(tmp_path / "uninterrupted", options, batch_size=size, max_epochs=14)
    expected.fit()
    draw = random.Random(3)
    for stops in range(10):
        trainer = make_trainer(tmp_path, options, batch_size=size, max_epochs=14)
        if stops:
            trainer.restore(trainer.last_path)
        left = expected.step - trainer.step
        stop_after(trainer, draw.randint(1, max(1, left // (11 - stops))))
        with pytest.raises(Interrupted):
            trainer.fit()
    trainer = make_trainer(tmp_path, options, batch_size=size, max_epochs=14)
    resumed(trainer, trainer.last_path)
    assert identical(parameters(expected), parameters(trainer))
    assert expected.history == trainer.history
    a, b = load_checkpoint(expected.best_path), load_checkpoint(trainer.best_path)
    assert identical(list(a.model.values()), list(b.model.values()))


@pytest.mark.parametrize("evaluation", [0, 1, 3])
def test_signal_during_an_evaluation_stops_at_once(
    make_trainer: Make, tmp_path: Path, evaluation: int
) -> None:
    expected = make_trainer(tmp_path / "uninterrupted")
    expected.fit()
    trainer = make_trainer(tmp_path)
    costs, count = trainer.costs, [0]

    def interrupted() -> dict[str, float]:
        if count[0] == evaluation:
            os.kill(os.getpid(), signal.SIGTERM)
        count[0] += 1
        return costs()

    trainer.costs = interrupted
    with pytest.raises(Interrupted):
        trainer.fit()
    assert len(trainer.history) == evaluation
    continued = resumed(make_trainer(tmp_path), trainer.last_path)
    assert continued.history == expected.history
    assert identical(parameters(expected), parameters(continued))


def test_resume_from_the_best_checkpoint_is_bit_identical(
    make_trainer: Make, tmp_path: Path
) -> None:
    expected = make_trainer(tmp_path / "a")
    expected.fit()
    continued = resumed(make_trainer(tmp_path / "b"), expected.best_path)
    assert identical(parameters(expected), parameters(continued))


def test_resume_in_another_folder_keeps_the_best_checkpoint(
    make_trainer: Make, tmp_path: Path
) -> None:
    first = make_trainer(tmp_path / "a", max_epochs=3)
    first.fit()
    continued = resumed(make_trainer(tmp_path / "b", max_epochs=3), first.last_path)
    assert load_checkpoint(continued.best_path).progress["best"] == first.best


def test_sigint_saves_and_restores_the_signal_handler(make_trainer: Make, tmp_path: Path) -> None:
    trainer = make_trainer(tmp_path)
    before = signal.getsignal(signal.SIGINT)
    stop_after(trainer, 2, signal.SIGINT)
    with pytest.raises(Interrupted) as stop:
        trainer.fit()
    assert stop.value.signal == signal.SIGINT
    assert load_checkpoint(trainer.last_path).progress["step"] == 2
    assert signal.getsignal(signal.SIGINT) is before


def test_nonfinite_cost_stops_with_the_last_finite_checkpoint(
    make_trainer: Make, tmp_path: Path
) -> None:
    trainer = make_trainer(tmp_path, save_every=0.0)
    descend = trainer._descend

    def poison(batch: object) -> None:
        if trainer.step == 4:
            with torch.no_grad():
                trainer.model.terms[0].v0.fill_(float("nan"))
        descend(batch)

    trainer._descend = poison
    with pytest.raises(SimulationError, match=r"sequence r/00\d blew up: agent \d at"):
        trainer.fit()
    saved = load_checkpoint(trainer.last_path)
    assert saved.progress["step"] == 4
    assert all(bool(v.isfinite().all()) for v in saved.model.values())


def test_line_search_recovers_from_failed_simulations(make_trainer: Make, tmp_path: Path) -> None:
    trainer = make_trainer(tmp_path, LbfgsOptions(max_iter=20), batch_size=0, max_epochs=6)
    solver, calls = trainer.solver, [0]

    def fragile(system: System, batch: Batch) -> Trajectory:
        calls[0] += torch.is_grad_enabled()
        if torch.is_grad_enabled() and calls[0] in (4, 5):
            raise SimulationError("too far")
        return solver(system, batch)

    trainer.solver = fragile
    trainer.fit()
    assert calls[0] > 5
    assert trainer.history[-1]["cost/train"] < 0.01 * trainer.history[0]["cost/train"]


def test_tensorboard_contains_the_history(make_trainer: Make, tmp_path: Path) -> None:
    trainer = make_trainer(tmp_path, max_epochs=3)
    stop_after(trainer, 4)
    with pytest.raises(Interrupted):
        trainer.fit()
    continued = resumed(make_trainer(tmp_path, max_epochs=3), trainer.last_path)
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    for name in ("cost/train", "cost/heldout", "gradient_norm", "noise", "parameters/lin.v0"):
        written = {event.step: event.value for event in events.Scalars(name)}
        expected = {int(row["step"]): row[name] for row in continued.history if name in row}
        assert written == pytest.approx(expected)
