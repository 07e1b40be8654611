"""Published figures, as the studies' ``printed.yaml`` has them with their sources."""

from __future__ import annotations

from importlib.resources import files
from types import SimpleNamespace

import yaml


def published(package: str) -> SimpleNamespace:
    """The entries of the ``printed.yaml`` of a study's package, as attributes."""
    text = files(package).joinpath("printed.yaml").read_text(encoding="utf-8")
    return SimpleNamespace(**yaml.safe_load(text))
