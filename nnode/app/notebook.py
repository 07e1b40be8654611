"""Calibrate in a notebook: a table in, an object to look at out."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import pandas as pd
from matplotlib.figure import Figure
from omegaconf import OmegaConf

from nnode.app.cli.sweep import RESULT
from nnode.app.python_inputs import Table, model_options, table_options
from nnode.app.train import train
from nnode.calibrate.checkpoint import load
from nnode.calibrate.optimizers import LbfgsOptions
from nnode.calibrate.options import FusedOptions, TrainerOptions
from nnode.models import System
from nnode.models.term import short_names
from nnode.plots import force_figure


@dataclass(frozen=True)
class Calibration:
    """A calibrated model.

    Attributes:
        model: a torch module, at its best epoch.
        folder: holds checkpoints and TensorBoard curves as ``scripts/train.py`` writes them.
        history: one row per evaluation: epoch, costs, parameters.
        summary: what the script prints at its end.
    """

    model: System
    folder: Path
    history: pd.DataFrame
    summary: dict[str, Any]

    def __repr__(self) -> str:
        short = short_names(map(str, self.parameters.index))
        rows = [
            f"  {short[str(name)]} = {row.value:.5g} {row.unit}"
            for name, row in self.parameters.iterrows()
        ]
        train, heldout = self.summary["cost_train"], self.summary.get("cost_heldout")
        cost = f"cost of a training sequence {train:.4g} m² s"
        if heldout is not None:
            cost += f", of a held-out one {heldout:.4g} m² s"
        head = f"{self.summary['model']}, calibrated: {cost}"
        return "\n".join([head, *rows, f"  folder {self.folder}", "  .plot() .model .history"])

    def plot(self) -> Figure:
        """The calibrated speed curve, or the force between two people."""
        return force_figure(self.model)

    @property
    def parameters(self) -> pd.DataFrame:
        """Value and unit of every physical parameter, by its address such as ``lin.v0``."""
        rows = {name: (float(value), unit) for name, (value, unit) in self.model.physical().items()}
        return pd.DataFrame.from_dict(rows, orient="index", columns=["value", "unit"])


def fit(
    data: Table,
    domain: str,
    *,
    model: str | Mapping[str, Any] = "lin",
    walls: str | Path | None = None,
    leader: str = "constant",
    epochs: int = 100,
    heldout: float = 0.2,
    seed: int = 0,
    folder: str | Path | None = None,
) -> Calibration:
    """Calibrate a model to a tidy table by L-BFGS on compiled kernels.

    For other optimisers, solvers and options there is ``scripts/train.py``.

    Args:
        data: CSV or Parquet, or a data frame, with ``sequence, time, agent, x`` and, where they
            exist, ``y`` and more, SI units; see ``docs/data.md``.
        domain: ``traffic`` or ``crowd``.
        model: a name as in ``conf/model``, or a model's options with its ``term``.
        walls: CSV with x1, y1, x2, y2, m.
        leader: of a traffic model: ``constant`` or ``measured``.
        epochs: at most.
        heldout: share of the sequences that the calibration does not see.
        seed: of start weights and of the split.
        folder: receives checkpoints and curves; by default a new temporary one.

    Raises:
        NNodeError: a table, a model or options that do not fit; the message says what to do.
    """
    place = Path(mkdtemp(prefix="nnode-fit-")) if folder is None else Path(folder)
    place.mkdir(parents=True, exist_ok=True)
    own = model_options(model, leader)
    options = table_options(data, domain, walls, place)
    options.split.heldout = heldout
    config = OmegaConf.create(
        {
            "model": own,
            "data": OmegaConf.structured(options),
            "solver": OmegaConf.structured(FusedOptions()),
            "optimizer": OmegaConf.structured(LbfgsOptions()),
            "trainer": OmegaConf.structured(TrainerOptions(max_epochs=epochs, figure_every=0)),
            "seed": seed,
            "resume": None,
            "groups": {
                "model": str(own["name"]),
                "data": "table",
                "solver": "fused",
                "optimizer": "lbfgs",
            },
        }
    )
    with redirect_stdout(StringIO()) as printed:
        train(config, place)
    logging.getLogger(__name__).info("%s", printed.getvalue())
    result = json.loads((place / RESULT).read_text())
    return Calibration(
        model=load(place / "checkpoints" / "best.pt"),
        folder=place,
        history=pd.DataFrame(result["history"]),
        summary=result["summary"],
    )
