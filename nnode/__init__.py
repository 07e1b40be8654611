"""nnode: calibrate interacting particle systems to measured trajectories."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from nnode.version import VERSION as __version__

if TYPE_CHECKING:
    from nnode.app.discover import diagnose_table as diagnose
    from nnode.app.drive import drive_run as drive
    from nnode.app.notebook import fit
    from nnode.calibrate.checkpoint import load

__all__ = ["__version__", "diagnose", "drive", "fit", "load"]

#: Where each name comes from: imported on first use, a short command should not wait for torch.
_HOMES = {
    "diagnose": ("nnode.app.discover", "diagnose_table"),
    "drive": ("nnode.app.drive", "drive_run"),
    "fit": ("nnode.app.notebook", "fit"),
    "load": ("nnode.calibrate.checkpoint", "load"),
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        module, attribute = _HOMES[name]
        return getattr(import_module(module), attribute)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)  # for completion, which imports nothing
