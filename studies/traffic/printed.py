"""Numbers printed in section 5 of Göttlich & Totzeck, to be set beside ours."""

from __future__ import annotations

from studies.printed import told

_TOLD = told(__package__)
RECORDINGS = _TOLD["recordings"]
LENGTHS = _TOLD["lengths"]
COSTS = _TOLD["costs"]
AVERAGE_LENGTHS = _TOLD["average_lengths"]
AVERAGE_COSTS = _TOLD["average_costs"]
