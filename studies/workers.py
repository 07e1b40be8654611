"""Workers for independent tasks: this process, processes of this machine, and those of Dask."""

from __future__ import annotations

import json
import multiprocessing
import os
import pickle
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

import numpy as np
import torch

from nnode.calibrate.interrupt import BreakingGuard, Interrupted, InterruptGuard
from nnode.errors import ConfigError, NNodeError, StudyError

#: A function and its keyword arguments.
Call = tuple[Callable[..., dict[str, Any]], dict[str, Any]]

#: Seconds after which a request to stop is seen at the latest.
POLL = 0.2

#: Read by the libraries when they are loaded: workers share the cores among themselves.
_ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}


@dataclass(frozen=True)
class Outcome:
    """What became of a call.

    Attributes:
        text: the result as JSON; None where the call failed.
        error: why it failed, in one line.
        trace: where it failed; empty for errors that the toolkit raises on purpose.
        seconds: how long it took.
    """

    text: str | None = None
    error: str = ""
    trace: str = ""
    seconds: float = 0.0


def attempt(call: Callable[[], Call]) -> Outcome:
    """Make a call, in this process; its errors become an outcome."""
    start = time.perf_counter()
    try:
        function, arguments = call()
        result = function(**arguments)
        if not isinstance(result, dict):
            raise TypeError(f"{function.__qualname__} returned {type(result).__name__}, not a dict")
        text = json.dumps(result, ensure_ascii=False, allow_nan=True, default=_plain)
        return Outcome(text, seconds=time.perf_counter() - start)
    except Interrupted:
        raise
    except NNodeError as error:
        return Outcome(error=str(error))
    except Exception as error:
        text = f"{type(error).__name__}: {error}"
        return Outcome(error=text, trace=traceback.format_exc())


def _plain(value: object) -> Any:
    """Arrays and NumPy's numbers as JSON has them."""
    if isinstance(value, np.ndarray | np.generic | torch.Tensor):
        return value.tolist()
    raise TypeError(f"Object of type {type(value).__name__} is not JSON serializable")


def calls_here(
    calls: Iterable[tuple[str, Call]], guard: InterruptGuard
) -> Generator[tuple[str, Outcome], None, None]:
    """Make named calls one after the other; a request to stop breaks off the present one."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for key, call in calls:
            breaking = BreakingGuard()
            try:
                with breaking:
                    outcome = attempt(lambda call=call: call)  # type: ignore[misc]
            except KeyboardInterrupt:
                guard.requested = breaking.requested
            except Interrupted as error:
                guard.requested = error.signal
            if guard.requested is not None:
                return
            yield key, outcome
    finally:
        torch.set_num_threads(before)


def calls_in_processes(
    calls: Iterable[tuple[str, Call]],
    count: int,
    guard: InterruptGuard,
    tick: Callable[[], None],
) -> Generator[tuple[str, Outcome], None, None]:
    """Make named calls in ``count`` processes, in the given order.

    Ends early when the guard was asked to stop; unfinished calls are lost. The call of a process
    that died becomes a failed outcome, and another process takes its place.

    Args:
        tick: called a few times per second.

    Raises:
        StudyError: a process ended before it could work.
    """
    waiting = deque(calls)
    crew: list[_Worker] = []
    try:
        crew = [_Worker() for _ in range(min(count, len(waiting)))]
        while (waiting or any(w.key for w in crew)) and guard.requested is None:
            tick()
            heard = wait([worker.connection for worker in crew], timeout=POLL)
            for worker in [w for w in crew if w.connection in heard]:
                key = worker.key
                try:
                    outcome = worker.connection.recv()
                except (EOFError, OSError):
                    if guard.requested is not None:
                        break  # whoever stops this process may have stopped all of them
                    crew.remove(worker)
                    outcome = Outcome(error=worker.bury())
                    if waiting:
                        crew.append(_Worker())
                else:
                    worker.take(waiting.popleft() if waiting else None)
                if key and outcome:
                    yield key, outcome
    finally:
        for worker in crew:
            worker.end()


class _Worker:
    """One process, its connection, and the name of the call that it is making."""

    def __init__(self) -> None:
        self.key: str | None = None
        self.ready = False
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process: BaseProcess = context.Process(target=_work, args=(theirs,), daemon=True)
        with _inherited():
            self.process.start()
        theirs.close()

    def take(self, call: tuple[str, Call] | None) -> None:
        """Give the worker, which has just reported, its next call or nothing to do."""
        self.ready = True
        self.key = None
        if call:
            self.key = call[0]
            # one that died in this moment is found out by the next look at its connection
            with suppress(OSError):
                self.connection.send(call[1])

    def bury(self) -> str:
        """Why the process ended."""
        # it closed its connection, so it is on its way out with a status of its own
        self.process.join(timeout=10.0)
        self.end()
        code = self.process.exitcode or 0
        if code < 0:
            name = signal.Signals(-code).name
            memory = ", as happens where memory runs out" if -code == signal.SIGKILL else ""
            why = f"its process was ended by signal {-code} ({name}){memory}"
        else:
            why = f"its process ended by itself with status {code}"
        if not self.ready:
            raise StudyError(
                f"a worker process cannot start: {why}; see the messages above, or use "
                "study.workers=1 to work without"
            )
        return why

    def end(self) -> None:
        self.process.kill()
        self.process.join()
        self.connection.close()


@contextmanager
def _inherited() -> Iterator[None]:
    """What a process that is started inside gets: one thread, and no Ctrl-C of its own.

    A terminal sends Ctrl-C to all processes; only the one that waits for them shall answer.
    """
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(_ONE_THREAD)
    # started with the first process otherwise, and then it lifts the block
    resource_tracker.ensure_running()
    block = getattr(signal, "pthread_sigmask", None)
    mask = block(signal.SIG_BLOCK, {signal.SIGINT}) if block else set()
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        if block:
            block(signal.SIG_SETMASK, mask)


def _work(connection: Connection) -> None:
    """Make calls until nobody asks for more."""
    threading.Thread(target=_leave_together, daemon=True).start()
    torch.set_num_threads(1)
    connection.send(None)
    while True:
        try:
            call = connection.recv_bytes()
        except (EOFError, OSError):
            return
        # read inside: a function that cannot be imported here is that call's failure
        connection.send(attempt(partial(pickle.loads, call)))


def _leave_together() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


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
