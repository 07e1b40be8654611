"""Published figures of prediction."""

from __future__ import annotations

from studies.printed import told

_TOLD = told(__package__)
IDM = _TOLD["idm"]
LEARNED = _TOLD["learned"]
CONSTANT_VELOCITY = _TOLD["constant_velocity"]
