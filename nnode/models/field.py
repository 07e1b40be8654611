"""Laws that the field uses, as formulas: what ``model.law`` says of each."""

from __future__ import annotations

from typing import Any

#: Name of the law to its description; see :class:`nnode.models.own_law.FormulaLaw`.
FIELD: dict[str, dict[str, Any]] = {
    "idm": {
        "parameters": {
            "v0": {"value": "30 m/s", "low": "1 m/s", "high": "60 m/s"},
            "T": {"value": "1.2 s", "low": "0.05 s", "high": "5 s"},
            "s0": {"value": "2 m", "low": "0.1 m", "high": "20 m"},
            "a": {"value": "1.3 m/s²", "low": "0.05 m/s²", "high": "8 m/s²"},
            "b": {"value": "1.7 m/s²", "low": "0.05 m/s²", "high": "10 m/s²"},
        },
        # bumper to bumper where lengths are known; without them s0 contains the vehicle's
        "where": {
            "net": "gap - length_1",
            "wish": "s0 + max(v*T + v*dv/(2*sqrt(a*b)), 0)",
        },
        "rate": {"v": "a*(1 - (v/v0)**4 - (wish/net)**2)"},
        "source": "Treiber, Hennecke & Helbing 2000",
    },
}
