"""Laws of other programs as formulas: ``laws.yaml``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

#: Name to the entry, as :func:`nnode.model.laws.law_from` takes it.
LAWS: dict[str, dict[str, Any]] = yaml.safe_load(
    Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8")
)
