"""Plots of calibrated forces and speed curves: ``nnode plot_forces``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from omegaconf import DictConfig

from nnode.app.cli.saved import load_run
from nnode.app.saved_run import opened
from nnode.calibrate.checkpoint import Checkpoint
from nnode.errors import ConfigError, DownloadError
from nnode.files import file_name, write_csv
from nnode.model import System
from nnode.plots import (
    curve_table,
    force_contours,
    measured_gaps,
    save,
    six_settings,
    speed_curves,
)


def _label(checkpoint: Checkpoint, taken: set[str]) -> str:
    config = checkpoint.config
    label = str(config["model"]["name"])
    for extra in (
        config["data"]["recording"],
        f"seed {config['seed']}",
        checkpoint.progress["step"],
    ):
        if label not in taken:
            break
        label += f", {extra}"
    while label in taken:
        label += "'"
    taken.add(label)
    return label


def plot_forces(config: DictConfig, folder: Path) -> None:
    """Draw the checkpoints' forces into ``folder``.

    Raises:
        NNodeError: a checkpoint is missing or damaged, or traffic and crowd models are mixed.
    """
    given = config.checkpoint
    paths = [given] if isinstance(given, str) else list(given)
    if not paths:
        raise ConfigError("checkpoint=[] names no checkpoint; give one or more paths")
    checkpoints = [load_run(path) for path in paths]
    taken: set[str] = set()
    models = {_label(checkpoint, taken): checkpoint.build() for checkpoint in checkpoints}
    domains = {model.domain for model in models.values()}
    if len(domains) > 1:
        raise ConfigError("checkpoint=[...] mixes traffic and crowd models; plot them one by one")
    folder.mkdir(parents=True, exist_ok=True)
    written = (
        _traffic(models, config, checkpoints[0], folder)
        if domains == {"traffic"}
        else _crowd(models, config.extent, folder)
    )
    for path in written:
        print(f"plot: {path}" if path.suffix == ".png" else f"table: {path}")


def _traffic(
    models: dict[str, System], config: DictConfig, first: Checkpoint, folder: Path
) -> list[Path]:
    try:
        _, store = opened(first, config, folder)
        gaps = measured_gaps(store[i] for i in range(len(store)))
    except DownloadError as error:
        print(f"no histogram of gaps: {error}")
        gaps = None
    save(speed_curves(models, gaps), folder / "forces.png")
    write_csv(folder / "forces.csv", curve_table(models, np.linspace(2, 50, 97)))
    return [folder / "forces.png", folder / "forces.csv"]


def _crowd(models: dict[str, System], extent: float | None, folder: Path) -> list[Path]:
    written: list[Path] = []
    for label, model in models.items():
        # the label comes from the checkpoint and may have any characters
        stem = file_name(label.replace(", ", "_").replace(" ", ""))
        while folder / f"{stem}_settings.png" in written:  # replaced characters may cause clashes
            stem += "_"
        for component, axis in enumerate("xy"):
            path = folder / f"{stem}_force_{axis}.png"
            save(force_contours(model, component, extent=extent), path)
            written.append(path)
        figure, table = six_settings(model)
        save(figure, folder / f"{stem}_settings.png")
        write_csv(folder / f"{stem}_settings.csv", table)
        written += [folder / f"{stem}_settings.png", folder / f"{stem}_settings.csv"]
    return written
