"""Data-parallel calibration in several processes, through torch's distributed package.

``torchrun`` starts the processes and numbers them. Every process has the same model and its share
of each mini-batch. Sums over processes (cost, gradient, errors, requests to stop) are equal in all
processes, so all take the same step without exchanging parameters.
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

#: Time limit of waiting for other processes, since the first process prepares the data.
PATIENCE = timedelta(hours=24)


class LostProcess(NNodeError):
    """Another process of the run has ended, so this process cannot continue."""


def started_together() -> bool:
    """Whether ``torchrun``, or a launcher with the same environment, started several processes."""
    launched = all(name in os.environ for name in ("RANK", "MASTER_ADDR", "MASTER_PORT"))
    return launched and int(os.environ.get("WORLD_SIZE", "1")) > 1


def join() -> None:
    """Connect the processes that were started together; does nothing for a single process.

    Raises:
        ConfigError: the connection fails.
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
    # the threads of the group must end before the interpreter does
    atexit.register(_leave)


class World:
    """The processes of this run, from the point of view of one process.

    Attributes:
        rank: number of this process, from 0.
        size: number of processes.
    """

    #: Whether all processes raised the last error of this process.
    agreed: ClassVar[bool] = False

    def __init__(self) -> None:
        together = dist.is_available() and dist.is_initialized()
        self.rank = dist.get_rank() if together else 0
        self.size = dist.get_world_size() if together else 1
        self._device = torch.device("cpu")

    @property
    def first(self) -> bool:
        """Whether this process writes files and prints."""
        return self.rank == 0

    def use(self, option: Device, name: str) -> torch.device:
        """The device of this process; the processes of a machine are distributed over its GPUs.

        Args:
            option: ``auto`` is a CUDA device if torch finds one, or else the CPU.
            name: name of the option, for the error message.

        Raises:
            ConfigError: ``cuda``, but torch finds no CUDA device.
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
        self._device = torch.device("cpu") if self.maximum(not alone) else device
        return device

    def maximum(self, number: int) -> int:
        """The largest of the processes' numbers."""
        if self.size == 1:
            return int(number)
        value = torch.tensor(int(number))
        with _others():
            dist.all_reduce(value, dist.ReduceOp.MAX)
        return int(value)

    def total(self, values: Tensor) -> Tensor:
        """Sum over the processes, in float64, equal to the bit in all processes."""
        if self.size == 1:
            return values
        result = values.detach().to(self._device, torch.float64, copy=True)
        with _others():
            dist.all_reduce(result)
        return result.to(values.device)

    def from_first(self, value: T) -> T:
        """The value of the first process, in all processes."""
        objects: list[Any] = [value]
        if self.size > 1:
            with _others():
                dist.broadcast_object_list(objects, src=0)
        received: T = objects[0]
        return received

    def agree(self, error: NNodeError | None) -> None:
        """Raise an error in every process if any process has one."""
        if self.size == 1:
            if error is not None:
                raise error
            return
        World.agreed = False
        errors: list[Any] = [None] * self.size
        with _others():
            dist.all_gather_object(errors, None if error is None else (type(error), str(error)))
        for item in errors:
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
            error: the error of this process, or None.

        Raises:
            NNodeError: the error of the first process that has one, in all processes.
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
        for p, has_gradient in zip(trained, summed[2:start].tolist(), strict=True):
            share = summed[start : start + p.numel()]
            p.grad = share.view_as(p).to(p) if has_gradient else None
            start += p.numel()
        return summed[1].to(cost)

    def barrier(self) -> None:
        """Wait until all processes have called this method."""
        if self.size > 1:
            with _others():
                dist.barrier()

    def leave(self) -> None:
        """Disconnect from the other processes after all have called this method, without waiting
        for processes that have ended."""
        if self.size == 1:
            return
        with suppress(RuntimeError):
            # torchrun ends all processes as soon as one ends with an error
            dist.all_reduce(torch.zeros(1))
        _leave()


def _leave() -> None:
    if dist.is_initialized():
        dist.destroy_process_group()
        # reference cycles would keep the threads of the group alive
        gc.collect()


@contextmanager
def _others() -> Iterator[None]:
    """Raise LostProcess if the communication fails."""
    try:
        yield
    except RuntimeError as error:
        raise LostProcess(
            "another process of this run has ended early; what it said stands above. The last "
            "checkpoint is whole: go on with resume="
        ) from error
