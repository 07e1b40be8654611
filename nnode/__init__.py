"""nnode: calibrate interacting particle systems to measured trajectories."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from nnode.calibrate.checkpoint import load

__all__ = ["__version__", "load"]


def __getattr__(name: str) -> Any:
    # imported on first use: a short command should not wait for torch
    if name == "load":
        return import_module("nnode.calibrate.checkpoint").load
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
