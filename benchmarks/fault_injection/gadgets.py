"""Checkpoints that nobody should open: pickles that call, archives that swell or climb."""

from __future__ import annotations

import builtins
import io
import os
import pickle
import random
import subprocess
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from benchmarks.fault_injection.inputs import NASTY, damaged_bytes


class Calls:
    """Unpickling this calls a function."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return self.call


def gadget(rng: random.Random, outside: Path) -> Calls:
    """An object whose unpickling would write ``outside``, run a program or eat memory."""
    return rng.choice(
        [
            Calls(os.system, f"touch {outside}"),
            Calls(subprocess.Popen, ["touch", str(outside)]),
            Calls(builtins.exec, f"open({str(outside)!r}, 'w').close()"),
            Calls(builtins.eval, f"open({str(outside)!r}, 'w').close()"),
            Calls(builtins.open, str(outside), "w"),
            Calls(builtins.__import__, "this"),
            Calls(os.mkdir, str(outside)),
            Calls(torch.save, {}, str(outside)),
            Calls(torch.load, str(outside)),
            Calls(bytearray, 1 << rng.choice((33, 40, 62))),
            Calls(torch.zeros, 1 << 40),
        ]
    )


def repacked(
    content: bytes, rng: random.Random, change: Callable[[str, bytes], tuple[str, bytes]], kind: int
) -> bytes:
    """An archive with its records changed and packed as ``kind`` says."""
    made = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as before, zipfile.ZipFile(made, "w", kind) as after:
        for name in before.namelist():
            after.writestr(*change(name, before.read(name)))
    return made.getvalue()


def evil_checkpoint(content: bytes, rng: random.Random, outside: Path) -> bytes:
    """A checkpoint turned into a weapon of a kind drawn at random."""
    stored, packed = zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED
    pickled = pickle.dumps({"config": gadget(rng, outside)}, protocol=rng.choice((2, 4)))

    def pickle_changed(new: Callable[[bytes], bytes]) -> Callable[[str, bytes], tuple[str, bytes]]:
        return lambda name, data: (name, new(data) if name.endswith("data.pkl") else data)

    match rng.randrange(6):
        case 0:
            return pickled
        case 1:
            return repacked(content, rng, pickle_changed(lambda _: pickled), stored)
        case 2:
            return repacked(content, rng, pickle_changed(lambda d: damaged_bytes(d, rng)), stored)
        case 3:  # zeros, a thousand times smaller when packed
            size = rng.choice((1 << 16, 1 << 20, 1 << 22))
            return repacked(content, rng, pickle_changed(lambda d: d + bytes(size)), packed)
        case 4:
            up = rng.choice(("../" * 6, "/", "..\\" * 4)) + outside.name
            return repacked(content, rng, lambda name, data: (f"{up}/{name}", data), stored)
        case _:
            made = io.BytesIO()
            torch.save(
                {
                    **torch.load(io.BytesIO(content), weights_only=True),
                    "config": gadget(rng, outside),
                },
                made,
            )
            return made.getvalue()


def strange_checkpoint(content: bytes, rng: random.Random) -> bytes:
    """A checkpoint that opens, with one to three of its values replaced by strange ones."""
    whole: Any = torch.load(io.BytesIO(content), weights_only=True)
    for _ in range(rng.randint(1, 3)):
        place: Any = whole
        while True:
            keys = list(place) if isinstance(place, dict) else list(range(len(place)))
            if not keys:
                break
            key = rng.choice(keys)
            if isinstance(place[key], dict | list) and place[key] and rng.random() < 0.8:
                place = place[key]
                continue
            if rng.random() < 0.2:
                del place[key]
            else:
                place[key] = rng.choice(
                    [
                        *NASTY,
                        None,
                        0,
                        -1,
                        10**18,
                        float("nan"),
                        float("inf"),
                        [],
                        {},
                        True,
                        b"x",
                        torch.zeros(0),
                        torch.full((2, 2), float("nan")),
                        torch.zeros(1).expand(10**6),
                        torch.tensor(1j),
                        {"a": 1},
                        [None],
                    ]
                )
            break
    made = io.BytesIO()
    torch.save(whole, made)
    return made.getvalue()
