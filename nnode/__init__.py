"""nnode: calibrate interacting particle systems to measured trajectories."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from nnode.version import VERSION as __version__

if TYPE_CHECKING:
    from nnode.app.calibration import Calibration
    from nnode.app.check import Check
    from nnode.app.check import check_file as check
    from nnode.app.discover import diagnose_table as diagnose
    from nnode.app.drive import drive_run as drive
    from nnode.app.predict import Predictions
    from nnode.app.predict import predict_run as predict
    from nnode.app.python.estimator import Calibrator, fit
    from nnode.app.python.inputs import sequences
    from nnode.app.python.report import Report
    from nnode.app.replay import replay
    from nnode.app.simulate import simulate_run as simulate
    from nnode.calibrate.checkpoint import load
    from nnode.data.sequence import Sequence
    from nnode.data.sequences import Sequences
    from nnode.generate.simulated import Simulated

__all__ = [
    "Calibration",
    "Calibrator",
    "Check",
    "Predictions",
    "Report",
    "Sequence",
    "Sequences",
    "Simulated",
    "__version__",
    "check",
    "diagnose",
    "drive",
    "fit",
    "load",
    "predict",
    "replay",
    "sequences",
    "simulate",
]

#: Where each name comes from: imported on first use, a short command should not wait for torch.
_HOMES = {
    "Calibration": ("nnode.app.calibration", "Calibration"),
    "Calibrator": ("nnode.app.python.estimator", "Calibrator"),
    "Predictions": ("nnode.app.predict", "Predictions"),
    "Report": ("nnode.app.python.report", "Report"),
    "Sequence": ("nnode.data.sequence", "Sequence"),
    "Sequences": ("nnode.data.sequences", "Sequences"),
    "Simulated": ("nnode.generate.simulated", "Simulated"),
    "Check": ("nnode.app.check", "Check"),
    "check": ("nnode.app.check", "check_file"),
    "diagnose": ("nnode.app.discover", "diagnose_table"),
    "drive": ("nnode.app.drive", "drive_run"),
    "fit": ("nnode.app.python.estimator", "fit"),
    "predict": ("nnode.app.predict", "predict_run"),
    "replay": ("nnode.app.replay", "replay"),
    "load": ("nnode.calibrate.checkpoint", "load"),
    "sequences": ("nnode.app.python.inputs", "sequences"),
    "simulate": ("nnode.app.simulate", "simulate_run"),
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        module, attribute = _HOMES[name]
        return getattr(import_module(module), attribute)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)  # for completion, which imports nothing
