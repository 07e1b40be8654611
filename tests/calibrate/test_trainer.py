"""The training loop: progress, projection, early stopping, and resuming to the last bit."""

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
    """Send this process a signal once ``steps`` more steps are done."""
    descend, left = trainer._descend, [steps]

    def counted(batch: object) -> None:
        descend(batch)  # type: ignore[arg-type]
        left[0] -= 1
        if left[0] == 0:
            os.kill(os.getpid(), number)

    trainer._descend = counted  # type: ignore[method-assign]


def parameters(trainer: Trainer) -> list[torch.Tensor]:
    return [p.detach().clone() for p in trainer.model.parameters()]


def same_bits(a: list[torch.Tensor], b: list[torch.Tensor]) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def test_training_lowers_both_costs_and_recovers_the_law(
    make_trainer: Make, tmp_path: Path
) -> None:
    optimizer, solver = AdamOptions(lr=0.3), FusedSolver(0.02)
    trainer = make_trainer(tmp_path, optimizer, solver=solver, max_epochs=50, evaluate_every=50)
    trainer.fit()
    first, last = trainer.history[0], trainer.history[-1]
    assert last["cost/train"] < 1e-3 * first["cost/train"]
    assert last["cost/heldout"] < 1e-2 * first["cost/heldout"]
    # the data step 0.002 s, the model 0.02 s: equal up to the scheme's error
    assert last["parameters/lin.v0"] == pytest.approx(22, abs=0.1)
    assert last["parameters/lin.L"] == pytest.approx(4, abs=0.1)


def test_parameters_stay_in_their_admissible_set(make_trainer: Make, tmp_path: Path) -> None:
    trainer = make_trainer(tmp_path, AdamOptions(lr=3.0), max_epochs=8)
    trainer.fit()
    lengths = [row["parameters/lin.L"] for row in trainer.history]
    assert min(lengths) >= 2.0
    assert 2.0 in lengths  # the bound was met, so the projection did something


def test_best_checkpoint_holds_the_least_cost(make_trainer: Make, tmp_path: Path) -> None:
    # without momentum a step of 1 m/s jumps to and fro across the minimum
    trainer = make_trainer(tmp_path, AdamOptions(lr=1.0, beta1=0.0), max_epochs=40)
    trainer.fit()
    costs = [row["cost/train"] for row in trainer.history]
    best = load_checkpoint(trainer.best_path)
    assert best.history[-1]["cost/train"] == min(costs)
    model = best.build()
    expected = best.history[-1]["parameters/lin.v0"]
    assert float(model.physical()["lin.v0"][0]) == expected
    assert costs[-1] > min(costs)  # otherwise best and last would be the same thing


@pytest.mark.parametrize(
    ("options", "epochs"),
    [
        # the first evaluation is progress, the next three are not
        ({"max_epochs": 50, "patience": 3, "min_delta": 1e6}, [0, 1, 2, 3]),
        ({"max_epochs": 5, "evaluate_every": 2}, [0, 2, 4, 5]),
    ],
    ids=["patience", "evaluate_every"],
)
def test_which_epochs_are_evaluated(
    make_trainer: Make, tmp_path: Path, options: dict[str, float], epochs: list[int]
) -> None:
    trainer = make_trainer(tmp_path, **options)
    trainer.fit()
    assert [row["epoch"] for row in trainer.history] == epochs


@pytest.mark.parametrize(("options", "size"), OPTIMIZERS, ids=lambda v: getattr(v, "name", ""))
def test_ten_interruptions_change_no_bit(
    make_trainer: Make, tmp_path: Path, options: OptimizerOptions, size: int
) -> None:
    straight = make_trainer(tmp_path / "straight", options, batch_size=size, max_epochs=14)
    straight.fit()
    draw = random.Random(3)
    total = straight.step
    folder, stops = tmp_path / "broken", 0
    while True:
        trainer = make_trainer(folder, options, batch_size=size, max_epochs=14)
        if stops:
            trainer.restore(trainer.last_path)
        left = total - trainer.step
        if stops < 10:
            stop_after(trainer, draw.randint(1, max(1, left // (11 - stops))))
            with pytest.raises(Interrupted):
                trainer.fit()
            stops += 1
            continue
        trainer.fit()
        break
    assert stops == 10
    assert same_bits(parameters(straight), parameters(trainer))
    assert straight.history == trainer.history
    a, b = load_checkpoint(straight.best_path), load_checkpoint(trainer.best_path)
    assert same_bits(list(a.model.values()), list(b.model.values()))


@pytest.mark.parametrize("evaluation", [0, 1, 3])
def test_a_signal_during_an_evaluation_is_obeyed_at_once(
    make_trainer: Make, tmp_path: Path, evaluation: int
) -> None:
    straight = make_trainer(tmp_path / "straight")
    straight.fit()
    trainer = make_trainer(tmp_path / "broken")
    costs, count = trainer.costs, [0]

    def interrupted() -> dict[str, float]:
        if count[0] == evaluation:
            os.kill(os.getpid(), signal.SIGTERM)
        count[0] += 1
        return costs()

    trainer.costs = interrupted  # type: ignore[method-assign]
    with pytest.raises(Interrupted):
        trainer.fit()
    assert len(trainer.history) == evaluation
    again = make_trainer(tmp_path / "broken")
    again.restore(trainer.last_path)
    again.fit()
    assert again.history == straight.history
    assert same_bits(parameters(straight), parameters(again))


def test_resuming_from_the_best_checkpoint_gives_the_same_end(
    make_trainer: Make, tmp_path: Path
) -> None:
    straight = make_trainer(tmp_path / "a")
    straight.fit()
    again = make_trainer(tmp_path / "b")
    again.restore(straight.best_path)
    assert again.epoch <= straight.epoch
    again.fit()
    assert same_bits(parameters(straight), parameters(again))


def test_resuming_in_another_folder_takes_the_best_along(
    make_trainer: Make, tmp_path: Path
) -> None:
    first = make_trainer(tmp_path / "a", max_epochs=3)
    first.fit()
    again = make_trainer(tmp_path / "b", max_epochs=3)
    again.restore(first.last_path)
    again.fit()
    best = load_checkpoint(again.best_path)
    assert best.progress["best"] == first.best


def test_sigint_saves_and_second_one_is_obeyed_by_python(
    make_trainer: Make, tmp_path: Path
) -> None:
    trainer = make_trainer(tmp_path)
    before = signal.getsignal(signal.SIGINT)
    stop_after(trainer, 2, signal.SIGINT)
    with pytest.raises(Interrupted) as stop:
        trainer.fit()
    assert stop.value.signal == signal.SIGINT
    assert load_checkpoint(trainer.last_path).progress["step"] == 2
    assert signal.getsignal(signal.SIGINT) is before


def test_a_cost_that_is_not_finite_stops_with_the_last_good_checkpoint(
    make_trainer: Make, tmp_path: Path
) -> None:
    trainer = make_trainer(tmp_path, save_every=0.0)
    descend = trainer._descend

    def poison(batch: object) -> None:
        if trainer.step == 4:
            with torch.no_grad():
                trainer.model.terms[0].v0.fill_(float("nan"))  # type: ignore[union-attr, operator]
        descend(batch)  # type: ignore[arg-type]

    trainer._descend = poison  # type: ignore[method-assign]
    with pytest.raises(SimulationError, match=r"sequence r/00\d blew up: agent \d at"):
        trainer.fit()
    saved = load_checkpoint(trainer.last_path)
    assert saved.progress["step"] == 4
    assert all(bool(v.isfinite().all()) for v in saved.model.values())


def test_a_line_search_that_goes_too_far_comes_back(make_trainer: Make, tmp_path: Path) -> None:
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


def test_tensorboard_holds_every_scalar_of_the_history(make_trainer: Make, tmp_path: Path) -> None:
    trainer = make_trainer(tmp_path, max_epochs=3)
    stop_after(trainer, 4)
    with pytest.raises(Interrupted):
        trainer.fit()
    again = make_trainer(tmp_path, max_epochs=3)
    again.restore(again.last_path)
    again.fit()
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    for name in ("cost/train", "cost/heldout", "gradient_norm", "noise", "parameters/lin.v0"):
        written = {event.step: event.value for event in events.Scalars(name)}
        expected = {int(row["step"]): row[name] for row in again.history if name in row}
        assert written == pytest.approx(expected)
