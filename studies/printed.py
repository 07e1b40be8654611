"""Published figures, as the studies' ``printed.yaml`` has them with their sources."""

from __future__ import annotations

from importlib.resources import files
from typing import Any

import yaml


def told(package: str) -> dict[str, Any]:
    """The entries of the ``printed.yaml`` of a study's package."""
    text = files(package).joinpath("printed.yaml").read_text(encoding="utf-8")
    return dict(yaml.safe_load(text))
