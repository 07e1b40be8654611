"""Tasks on many machines: through joblib, by whatever backend is active, such as Dask's.

On one machine tasks go to processes of :mod:`studies.workers`: joblib's own lose all that is
running where one of them dies, or where a signal asks to stop.
"""

from __future__ import annotations

import queue
import sys
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from functools import partial

import torch

from nnode.calibrate.interrupt import InterruptGuard
from nnode.errors import ConfigError
from studies.workers import POLL, Call, Outcome, attempt

#: Seconds that a scheduler has to answer.
ANSWER = 20.0
#: joblib's backends of one machine.
_HERE = ("LokyBackend", "ThreadingBackend", "SequentialBackend", "MultiprocessingBackend")


@contextmanager
def on_cluster(address: str | None) -> Iterator[None]:
    """Tasks go to the workers of a Dask scheduler while this is open; None changes nothing.

    Raises:
        ConfigError: Dask is not installed, or nobody answers at the address.
    """
    if address is None:
        yield
        return
    try:
        import joblib
        from distributed import Client
    except ImportError:
        raise ConfigError(
            f"cluster={address} needs Dask; install it with: pip install 'nnode[dask]'"
        ) from None
    try:
        client = Client(address, timeout=ANSWER, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"cluster={address}: no scheduler answers there ({error}); expected an address such "
            "as tcp://host:8786, where `dask scheduler` runs"
        ) from None
    with client, joblib.parallel_config(backend="dask", client=client):
        yield


def elsewhere() -> bool:
    """Whether joblib's active backend reaches beyond this machine."""
    joblib = sys.modules.get("joblib")
    if joblib is None:  # nobody chose a backend
        return False
    backend, _ = joblib.parallel.get_active_backend()
    return type(backend).__name__ not in _HERE


def calls_by_joblib(
    calls: Iterable[tuple[str, Call]], guard: InterruptGuard, tick: Callable[[], None]
) -> Generator[tuple[str, Outcome], None, None]:
    """Make named calls by joblib's active backend; their functions must be importable there.

    Ends early when the guard was asked to stop; unfinished calls are lost. A worker that dies is
    the backend's matter: Dask gives its calls to others.

    Args:
        tick: called a few times per second.
    """
    import joblib

    parallel = joblib.Parallel(return_as="generator_unordered", pre_dispatch="all")
    found = parallel(joblib.delayed(_named)(key, call) for key, call in calls)
    heard: queue.SimpleQueue[tuple[str, Outcome] | Exception | None] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(found, heard), daemon=True).start()
    while guard.requested is None:
        tick()
        try:
            one = heard.get(timeout=POLL)
        except queue.Empty:
            continue
        if one is None:
            return
        if isinstance(one, Exception):
            raise one
        yield one


def _listen(
    found: Iterable[tuple[str, Outcome]],
    heard: queue.SimpleQueue[tuple[str, Outcome] | Exception | None],
) -> None:
    """Results into a queue: a request to stop need not wait for the next one."""
    try:
        for one in found:
            heard.put(one)
    except Exception as error:
        heard.put(error)
    heard.put(None)


def _named(key: str, call: Call) -> tuple[str, Outcome]:
    torch.set_num_threads(1)
    return key, attempt(partial(_same, call))


def _same(call: Call) -> Call:
    return call
