"""Tasks on many machines: by the workers of a Dask scheduler."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable

import torch

from nnode.calibrate.interrupt import InterruptGuard
from nnode.errors import ConfigError
from studies.workers import POLL, Call, Outcome, attempt

#: Seconds that a scheduler has to answer.
ANSWER = 20.0


def calls_on_cluster(
    calls: Iterable[tuple[str, Call]],
    address: str,
    guard: InterruptGuard,
    tick: Callable[[], None],
) -> Generator[tuple[str, Outcome], None, None]:
    """Make named calls by the workers of a scheduler; their functions must be importable there.

    Ends early when the guard was asked to stop; unfinished calls are lost. Dask gives the calls of
    a worker that dies to others.

    Args:
        address: of the scheduler.
        tick: called a few times per second.

    Raises:
        ConfigError: Dask is not installed, or nobody answers at the address.
    """
    try:
        from distributed import Client, wait
    except ImportError:
        raise ConfigError(
            f"cluster={address} needs Dask; install it with: pip install 'nnode[dask]'"
        ) from None
    try:
        client = Client(address, timeout=ANSWER)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"cluster={address}: no scheduler answers there ({error}); expected an address such "
            "as tcp://host:8786, where `dask scheduler` runs"
        ) from None
    with client:
        keys = {client.submit(_attempt, call, pure=False): key for key, call in calls}
        waiting = set(keys)
        while waiting and guard.requested is None:
            tick()
            try:
                done, waiting = wait(waiting, timeout=POLL, return_when="FIRST_COMPLETED")
            except TimeoutError:
                continue
            for future in done:
                yield keys[future], future.result()


def _attempt(call: Call) -> Outcome:
    torch.set_num_threads(1)
    return attempt(lambda: call)
