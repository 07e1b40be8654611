"""Several processes that calibrate one model together, through torch's distributed package.

``torchrun`` starts them and tells each one its place. Every process holds the same model and
sees its share of each mini-batch; what they add up (cost, gradient, errors, requests to stop) is
the same number everywhere, so that all take the same step without sending parameters around.
"""

from __future__ import annotations

import atexit
import gc
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from typing import Any, ClassVar, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from nnode.calibrate.options import Device
from nnode.errors import ConfigError, NNodeError

T = TypeVar("T")

#: How long one process may keep the others waiting; the first prepares the data alone.
PATIENCE = timedelta(hours=24)


class LostProcess(NNodeError):
    """Another process of the run has ended, so that this one cannot go on."""


def started_together() -> bool:
    """Whether ``torchrun``, or a launcher with the same environment, started several processes."""
    told = all(name in os.environ for name in ("RANK", "MASTER_ADDR", "MASTER_PORT"))
    return told and int(os.environ.get("WORLD_SIZE", "1")) > 1


def join() -> None:
    """Meet the processes that were started together; nothing to do for one alone.

    Raises:
        ConfigError: they do not find each other.
    """
    if not started_together() or dist.is_initialized():
        return
    nccl = torch.cuda.is_available() and dist.is_nccl_available()
    try:
        dist.init_process_group("cpu:gloo,cuda:nccl" if nccl else "cpu:gloo", timeout=PATIENCE)
    except (RuntimeError, ValueError) as error:
        raise ConfigError(
            f"{os.environ['WORLD_SIZE']} processes cannot find each other: {error}; start them "
            "with torchrun --nproc-per-node=NUMBER -m nnode train"
        ) from error
    # the interpreter must not end with the threads of the group still running
    atexit.register(_leave)


class World:
    """The processes of this run, seen from one of them; a process alone is a world of one.

    Attributes:
        rank: number of this process, from 0.
        size: number of processes.
    """

    #: Whether the error that this process raised last was raised in all of them.
    agreed: ClassVar[bool] = False

    def __init__(self) -> None:
        together = dist.is_available() and dist.is_initialized()
        self.rank = dist.get_rank() if together else 0
        self.size = dist.get_world_size() if together else 1
        self._device = torch.device("cpu")

    @property
    def first(self) -> bool:
        """Whether this is the process that writes files and speaks."""
        return self.rank == 0

    def use(self, option: Device, name: str) -> torch.device:
        """The device of this process; several GPUs of a machine are shared out.

        Args:
            option: ``auto`` is a CUDA device where torch finds one, else the CPU.
            name: of the option, for the error.

        Raises:
            ConfigError: ``cuda`` where torch finds none.
        """
        with self.together():
            if option is Device.cuda and not torch.cuda.is_available():
                raise ConfigError(
                    f"{name}=cuda, but torch finds no CUDA device here; take {name}=auto or "
                    f"{name}=cpu, or install a torch with CUDA"
                )
        if option is Device.cpu or not torch.cuda.is_available():
            device, alone = torch.device("cpu"), False
        else:
            number, local = torch.cuda.device_count(), int(os.environ.get("LOCAL_RANK", "0"))
            device = torch.device("cuda", local % number if self.size > 1 else 0)
            torch.cuda.set_device(device)
            alone = int(os.environ.get("LOCAL_WORLD_SIZE", "1")) <= number
        # NCCL refuses two processes on one GPU; sums then go through the CPU
        self._device = torch.device("cpu") if self.most(not alone) else device
        return device

    def most(self, number: int) -> int:
        """The largest of the processes' numbers."""
        if self.size == 1:
            return int(number)
        value = torch.tensor(int(number))
        with _others():
            dist.all_reduce(value, dist.ReduceOp.MAX)
        return int(value)

    def total(self, values: Tensor) -> Tensor:
        """Sum over the processes, in float64; the same bits everywhere."""
        if self.size == 1:
            return values
        result = values.detach().to(self._device, torch.float64, copy=True)
        with _others():
            dist.all_reduce(result)
        return result.to(values.device)

    def from_first(self, value: T) -> T:
        """What the first process has, for all."""
        box: list[Any] = [value]
        if self.size > 1:
            with _others():
                dist.broadcast_object_list(box, src=0)
        found: T = box[0]
        return found

    def agree(self, error: NNodeError | None) -> None:
        """Raise in every process what one of them has to raise."""
        if self.size == 1:
            if error is not None:
                raise error
            return
        World.agreed = False
        found: list[Any] = [None] * self.size
        with _others():
            dist.all_gather_object(found, None if error is None else (type(error), str(error)))
        for item in found:
            if item is not None:
                World.agreed = True
                kind, message = item
                raise kind(message) from error

    @contextmanager
    def together(self) -> Iterator[None]:
        """An error inside the context is raised in all processes at its end.

        Nothing inside may wait for the other processes.
        """
        caught: NNodeError | None = None
        try:
            yield
        except NNodeError as error:
            caught = error
        self.agree(caught)

    def combine(
        self, cost: Tensor, parameters: Iterable[Tensor], error: NNodeError | None
    ) -> Tensor:
        """Add up the processes' costs, and in place their gradients.

        A process without a gradient counts as zero, unless no process has one.

        Args:
            cost: this process's part, a scalar.
            parameters: those that are trained; their ``grad`` becomes the sum.
            error: what went wrong in this process, if anything did.

        Raises:
            NNodeError: the error of the first process that has one, in all of them.
        """
        if self.size == 1:
            self.agree(error)
            return cost
        trained = list(parameters) if torch.is_grad_enabled() else []
        head = [float(error is not None), float(cost), *(p.grad is not None for p in trained)]
        parts = [torch.tensor(head, dtype=torch.float64, device=cost.device)]
        parts += [
            (torch.zeros_like(p) if p.grad is None else p.grad).detach().reshape(-1).double()
            for p in trained
        ]
        summed = self.total(torch.cat(parts))
        if summed[0] > 0:
            self.agree(error)
        start = len(head)
        for p, known in zip(trained, summed[2:start].tolist(), strict=True):
            share = summed[start : start + p.numel()]
            p.grad = share.view_as(p).to(p) if known else None
            start += p.numel()
        return summed[1].to(cost)

    def meet(self) -> None:
        """Wait until all processes are here."""
        if self.size > 1:
            with _others():
                dist.barrier()

    def part(self) -> None:
        """Leave the others, when all are ready to; whoever is gone already is not waited for."""
        if self.size == 1:
            return
        with suppress(RuntimeError):
            # torchrun ends the rest as soon as one process ends with an error
            dist.all_reduce(torch.zeros(1))
        _leave()


def _leave() -> None:
    if dist.is_initialized():
        dist.destroy_process_group()
        # whatever still refers to the group in a cycle would keep its threads to the very end
        gc.collect()


@contextmanager
def _others() -> Iterator[None]:
    """Say in words that another process is gone."""
    try:
        yield
    except RuntimeError as error:
        raise LostProcess(
            "another process of this run has ended early; what it said stands above. The last "
            "checkpoint is whole: go on with resume="
        ) from error
