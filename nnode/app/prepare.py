"""Preparation of raw recordings as sequences: ``nnode prepare_data``."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig

from nnode.app.cli.prepared import with_recognised
from nnode.app.cli.saved import options_of
from nnode.data.clusters import clusters, relation
from nnode.data.dataset import noise_of
from nnode.data.options import DataOptions
from nnode.data.prepare import prepare
from nnode.data.quality import interpolated_text, kinds_text, recorded
from nnode.plots.quality import plot_faults


def prepare_data(config: DictConfig, folder: Path) -> None:
    """Prepare a data set in ``folder``, and print a summary.

    Raises:
        NNodeError: see :func:`nnode.data.prepare.prepare`.
    """
    config = with_recognised(config)
    options: DataOptions = options_of(config.data)
    store = prepare(options, folder, draw=plot_faults)
    if kinds := kinds_text(recorded(store.manifest).values()):
        print(f"faults: {kinds} sequences; pictures in {folder / 'faults'}")
    if store.manifest["filled"]:
        print(interpolated_text(store.manifest["filled"]))
    print(noise_of(store))
    gap = options.split.gap
    number = int(clusters(store.index, gap).max()) + 1
    print(f"clusters: {number} (sequences that {relation(store.index, gap)} are one)")
    print(f"{len(store)} sequences: {folder} (train with data.prepared={folder})")
    print(f"manifest: {folder / 'manifest.json'}")
