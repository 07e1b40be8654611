"""Raw recordings to sequences: ``scripts/prepare_data.py``."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from nnode.data.options import DataOptions
from nnode.data.prepare import prepare


def prepare_data(config: DictConfig, folder: Path) -> None:
    """Prepare a data set into ``folder`` and say what came of it.

    Raises:
        NNodeError: see :func:`nnode.data.prepare.prepare`.
    """
    options: DataOptions = OmegaConf.to_object(config.data)  # type: ignore[assignment]
    store = prepare(options, folder)
    print(f"{len(store)} sequences: {folder}")
    print(f"manifest: {folder / 'manifest.json'}")
