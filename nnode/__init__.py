"""nnode: calibrate interacting particle systems to measured trajectories."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from nnode.version import VERSION as __version__

if TYPE_CHECKING:
    from nnode.app.discover import diagnose_table as diagnose
    from nnode.app.notebook import fit
    from nnode.app.replay import replay
    from nnode.calibrate.checkpoint import load

__all__ = ["__version__", "diagnose", "fit", "load", "replay"]

#: Where each name comes from: imported on first use, a short command should not wait for torch.
_HOMES = {
    "diagnose": ("nnode.app.discover", "diagnose_table"),
    "fit": ("nnode.app.notebook", "fit"),
    "replay": ("nnode.app.replay", "replay"),
    "load": ("nnode.calibrate.checkpoint", "load"),
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        module, attribute = _HOMES[name]
        return getattr(import_module(module), attribute)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)  # for completion, which imports nothing
