"""The training loop: optimisation steps, projection, evaluation and checkpoints."""

from __future__ import annotations

import copy
import logging
import math
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, cast

import torch
from torch import Tensor
from torch.optim import Optimizer
from torch.utils.data import DataLoader

from nnode.calibrate.checkpoint import Checkpoint, copied, load_checkpoint, save_checkpoint
from nnode.calibrate.cost import sequence_costs
from nnode.calibrate.distributed import World
from nnode.calibrate.evaluate import evaluate
from nnode.calibrate.interrupt import Interrupted, InterruptGuard
from nnode.calibrate.logbook import Logbook
from nnode.calibrate.optimizers.adadelta import NoisyAdadelta
from nnode.calibrate.optimizers.gauss_newton import GaussNewton
from nnode.calibrate.options import Monitor, TrainerOptions
from nnode.calibrate.progress import Reporter
from nnode.data.dataset import EpochSampler
from nnode.data.sequence import Batch
from nnode.errors import CheckpointError, ConfigError, SimulationError
from nnode.files import replacing
from nnode.model import System
from nnode.simulation.base import Solver

if TYPE_CHECKING:
    from matplotlib.figure import Figure

log = logging.getLogger(__name__)


@dataclass(kw_only=True)
class Provenance:
    """The origin of a checkpoint; see :class:`Checkpoint`."""

    config: dict[str, Any]
    manifest: dict[str, Any]
    split: dict[str, list[str]]
    free_speed: float | None = None


class _StopRequested(Exception):
    """A signal arrived during an evaluation, which a resumed run repeats."""


class Trainer:
    """Calibrates a model. A checkpoint at any mini-batch contains the state of a run.

    Several processes calibrate together if each has a trainer whose loaders give its share of the
    mini-batches. Only the first process writes files. Model, optimiser state and costs are equal
    in all processes, so a run may be resumed with another number of processes.

    Args:
        model, solver, optimizer: what is calibrated, and how.
        train: loader whose batch sampler is an :class:`EpochSampler`.
        heldout: loader of the held-out sequences, or None.
        options: see :class:`TrainerOptions`.
        folder: folder of ``checkpoints/`` and ``tensorboard/``; None writes nothing, and Ctrl-C
            ends the run at once.
        provenance: origin, stored in the checkpoints.
        figure: draws the model for TensorBoard.
        world: the processes that train together; by default the joined ones.
    """

    def __init__(
        self,
        model: System,
        solver: Solver,
        optimizer: Optimizer,
        train: DataLoader[Any],
        heldout: DataLoader[Any] | None,
        options: TrainerOptions,
        folder: Path | None,
        provenance: Provenance,
        figure: Callable[[System], Figure] | None = None,
        world: World | None = None,
    ) -> None:
        self.model, self.solver, self.optimizer = model, solver, optimizer
        self.train, self.heldout, self.options = train, heldout, options
        self.folder, self.provenance, self.figure = folder, provenance, figure
        self.world = world or World()
        first = next(model.parameters())
        self.dtype, self.device = first.dtype, first.device
        self.history: list[dict[str, float]] = []
        self.epoch = self.batch = self.step = 0
        self.sum, self.gradient_norm = 0.0, 0.0  # over the mini-batches of this epoch
        self.best, self.best_epoch, self.stale = float("inf"), -1, 0
        self.seconds = 0.0
        self._best: Checkpoint | None = None
        self._best_saved = True
        self._guard = InterruptGuard()
        self._clock = self._saved = time.monotonic()

    @property
    def last_path(self) -> Path:
        """The newest checkpoint."""
        assert self.folder is not None
        return self.folder / "checkpoints" / "last.pt"

    @property
    def best_path(self) -> Path:
        """The checkpoint with the lowest monitored cost."""
        return self.last_path.with_name("best.pt")

    def best_checkpoint(self) -> Checkpoint:
        """The state with the lowest monitored cost; for a resumed run it may be on the disk."""
        if self._best is None and self.folder is not None and self.best_path.is_file():
            return load_checkpoint(self.best_path)
        return self.checkpoint() if self._best is None else self._best

    # -- state ---------------------------------------------------------------------------

    _COUNTERS = (
        "epoch",
        "batch",
        "step",
        "sum",
        "gradient_norm",
        "best",
        "best_epoch",
        "stale",
        "seconds",
    )

    def checkpoint(self) -> Checkpoint:
        """The present state, copied."""
        now = time.monotonic()
        self.seconds += now - self._clock
        self._clock = now
        return Checkpoint(
            **vars(self.provenance),
            model=copied(dict(self.model.state_dict())),
            optimizer=copied(self.optimizer.state_dict()),
            progress={name: getattr(self, name) for name in self._COUNTERS},
            history=list(self.history),
        )

    def restore(self, path: Path) -> None:
        """Continue from the checkpoint at ``path``, of this run or of another folder.

        Raises:
            CheckpointError: see :func:`load_checkpoint`; or the checkpoint has another model or
                optimiser.
        """
        checkpoint = load_checkpoint(path)
        try:
            self.model.load_state_dict(checkpoint.model)
            self.optimizer.load_state_dict(checkpoint.optimizer)
            for name in self._COUNTERS:
                setattr(self, name, checkpoint.progress[name])
        except Exception as error:  # optimisers raise various errors for the state of another one
            raise CheckpointError(
                f"{path} does not fit the model and the optimiser of this run "
                f"({type(error).__name__}: {error}); take another checkpoint, or start a new run"
            ) from error
        self.history = list(checkpoint.history)
        best = path.parent / self.best_path.name
        foreign = best.is_file() and best.resolve() != self.best_path.resolve()
        if foreign and self.world.first:
            with replacing(self.best_path) as temporary:
                shutil.copyfile(best, temporary)

    def save(self) -> None:
        """Write the best checkpoint, if it is new, and then the last one."""
        if self.world.first and self.folder is not None:
            if self._best is not None and not self._best_saved:
                save_checkpoint(self._best, self.best_path)
            save_checkpoint(self.checkpoint(), self.last_path)
        self._best_saved = True
        self._saved = time.monotonic()

    # -- one step --------------------------------------------------------------------------

    def _gradient_norm(self) -> float:
        gradients = [p.grad.flatten() for p in self.model.parameters() if p.grad is not None]
        return float(torch.linalg.vector_norm(torch.cat(gradients))) if gradients else 0.0

    def _share(self, batch: Batch | None, number: int) -> Tensor:
        """This process's part of the mean cost of ``number`` sequences, and of its gradient."""
        if batch is None:
            return torch.zeros((), dtype=self.dtype, device=self.device)
        costs = sequence_costs(self.solver(self.model, batch), batch, self.options.cost)
        cost = costs.sum() / number
        if cost.requires_grad:
            cost.backward()
            if not math.isfinite(self._gradient_norm() + float(cost.detach())):
                raise SimulationError(
                    f"the cost of {', '.join(batch.names[:5])} ... or its gradient is not "
                    "finite; start from other parameters, or take a smaller solver.dt"
                )
        return cost.detach()

    def _descend(self, batch: Batch | None) -> None:
        batch = None if batch is None else batch.to(self.device, self.dtype)
        number = cast(EpochSampler, self.train.batch_sampler).sequences(self.batch)
        trained = [p for p in self.model.parameters() if p.requires_grad]
        norms: list[float] = []
        costs: list[float] = []

        def closure() -> Tensor:
            self.optimizer.zero_grad()
            share, error = torch.zeros((), dtype=self.dtype, device=self.device), None
            try:
                share = self._share(batch, number)
            except SimulationError as caught:
                error = caught
            try:
                cost = self.world.combine(share, trained, error)
            except SimulationError:
                if not torch.is_grad_enabled():
                    return torch.tensor(float("inf"))  # a trial point outside the model's range
                if not costs:
                    raise
                # a line search went too far: a high, flat cost shortens its step
                self.optimizer.zero_grad()
                return torch.tensor(1e3 * (1 + abs(costs[0])), dtype=self.dtype)
            norms.append(self._gradient_norm())
            costs.append(float(cost))
            return cost

        if isinstance(self.optimizer, GaussNewton):
            if self.world.size > 1 or batch is None:
                raise ConfigError("optimizer=gauss_newton works in one process only")
            self.optimizer.attach(self.solver, batch, self.options.cost, self.options.start_speeds)
            self.sum += self.optimizer.step()
            self.model.project_()
            return
        loss = cast(Tensor, self.optimizer.step(cast(Any, closure)))
        self.model.project_()
        self.sum += float(loss.detach())
        self.gradient_norm = norms[0] if norms else 0.0

    # -- evaluation ------------------------------------------------------------------------

    def costs(self) -> dict[str, float]:
        """Cost of the present model on the training and on the held-out sequences."""
        costs = {}
        for name, loader in (("train", self.train), ("heldout", self.heldout)):
            if loader is None:
                continue
            if name == "train":
                cast(EpochSampler, loader.batch_sampler).set_epoch(self.epoch)
            sums = torch.zeros(2, dtype=torch.float64)
            with self.world.together():
                metrics = evaluate(
                    lambda b: self.solver(self.model, b), self._shares(loader), self.options.cost
                )
                sums[0], sums[1] = metrics.J * metrics.sequences, metrics.sequences
            if self.world.size > 1:
                total, number = self.world.total(sums).tolist()
                costs[f"cost/{name}"] = total / number
            else:
                costs[f"cost/{name}"] = metrics.J
        return costs

    def _shares(self, loader: DataLoader[Any]) -> Iterator[Batch]:
        """This process's shares of the mini-batches, if they are not empty."""
        for batch in loader:
            # several processes can only stop together, after a step
            if self.world.size == 1 and self._guard.requested is not None:
                raise _StopRequested
            if batch is not None:
                placed, optimizer = batch.to(self.device, self.dtype), self.optimizer
                yield (
                    optimizer.with_start_speeds(placed)
                    if isinstance(optimizer, GaussNewton)
                    else placed
                )

    def _evaluate(self, logbook: Logbook | None, minibatch: float | None = None) -> None:
        row: dict[str, float] = {"epoch": float(self.epoch), "step": float(self.step)}
        row.update(self.costs())
        if minibatch is not None:
            row["cost/minibatch"] = minibatch
            row["gradient_norm"] = self.gradient_norm
        if isinstance(self.optimizer, NoisyAdadelta):
            row["noise"] = self.optimizer.noise
        for name, (value, _) in self.model.physical().items():
            row[f"parameters/{name}"] = float(value)
        self.history.append(row)
        if logbook is not None:
            logbook.scalars({k: v for k, v in row.items() if k not in ("epoch", "step")}, self.step)
        monitored = row.get(f"cost/{self.options.monitor.value}", row["cost/train"])
        if monitored < self.best - self.options.min_delta:
            self.best, self.best_epoch, self.stale = monitored, self.epoch, 0
            self._best, self._best_saved = self.checkpoint(), False
        else:
            self.stale += 1

    def _draw(self, logbook: Logbook | None) -> None:
        if self.figure is not None and logbook is not None:
            model = copy.deepcopy(self.model).cpu()  # plots need CPU tensors
            logbook.add_figure("force", self.figure(model), self.step)

    # -- the loop --------------------------------------------------------------------------

    def fit(self) -> None:
        """Train until ``max_epochs``, convergence, or the end of the patience.

        Raises:
            Interrupted: on SIGINT or SIGTERM to any of the processes, after saving.
            SimulationError: the cost or its gradient is not finite; the last good state is in
                the last checkpoint.
        """
        options, sampler = self.options, cast(EpochSampler, self.train.batch_sampler)
        per_epoch = sampler.n_batches
        if options.monitor is Monitor.heldout and self.heldout is None:
            log.warning("trainer.monitor=heldout, but no sequence is held out: watching train")
        fresh = self.step == 0 and not self.history
        logbook = None
        if self.world.first and self.folder is not None:
            logbook = Logbook(self.folder / "tensorboard", self.provenance.config, self.step)
        self._clock = time.monotonic()
        try:
            self._guard = InterruptGuard()
            with self._guard if self.folder is not None else nullcontext():
                reporter = None
                if self.world.first:
                    reporter = Reporter(options.max_epochs * per_epoch, self.step)
                with reporter or nullcontext():
                    if fresh:
                        self._start(logbook)
                    while self.epoch < options.max_epochs and not self._stalled():
                        sampler.set_epoch(self.epoch)
                        sampler.set_start(self.batch)
                        for batch in self.train:
                            self._descend(batch)
                            self.batch += 1
                            self.step += 1
                            if reporter is not None:
                                reporter.advance(self._note())
                            self._save_if_due()
                        self._end_epoch(logbook, per_epoch)
                        self._save_if_due()
                self.save()
            if logbook is not None:
                logbook.result({"cost/best": self.best})
        finally:
            if logbook is not None:
                logbook.close()

    def _start(self, logbook: Logbook | None) -> None:
        self.save()  # allows resuming if the first evaluation is interrupted
        try:
            self._evaluate(logbook)
        except _StopRequested:
            self._stop(self._guard.requested or 0)
        self._draw(logbook)
        self.save()

    def _end_epoch(self, logbook: Logbook | None, per_epoch: int) -> None:
        before = self.epoch, self.batch, self.sum
        # counters first, because a checkpoint made below belongs to the start of the next epoch
        self.epoch, self.batch, self.sum = self.epoch + 1, 0, 0.0
        last = self.epoch == self.options.max_epochs
        if self.epoch % self.options.evaluate_every == 0 or last:
            try:
                self._evaluate(logbook, before[2] / per_epoch)
            except _StopRequested:
                self.epoch, self.batch, self.sum = before
                self._stop(self._guard.requested or 0)
        every = self.options.figure_every
        if every and (self.epoch % every == 0 or last):
            self._draw(logbook)

    def _stalled(self) -> bool:
        done = isinstance(self.optimizer, GaussNewton) and self.optimizer.converged
        return done or (self.options.patience is not None and self.stale >= self.options.patience)

    def _note(self) -> str:
        return f"epoch {self.epoch + 1}, best {self.options.monitor.value} cost {self.best:.4g}"

    def _save_if_due(self) -> None:
        number = self.world.maximum(self._guard.requested or 0)
        if number:
            self._stop(number)
        if time.monotonic() - self._saved >= self.options.save_every:
            self.save()

    def _stop(self, number: int) -> NoReturn:
        """Save, and stop the run because of the signal ``number``."""
        self.save()
        self.world.barrier()  # no process ends before the state is on the disk
        World.agreed = True
        raise Interrupted(
            f"stopped at step {self.step} (epoch {self.epoch + 1}); "
            f"everything up to here is in {self.last_path}",
            number,
        )
