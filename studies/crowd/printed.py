"""Numbers printed in section 6 of Göttlich & Totzeck, to be set beside ours."""

from __future__ import annotations

import pandas as pd

from studies.printed import told

_TOLD = told(__package__)
PARAMETERS = _TOLD["parameters"]
COSTS = _TOLD["costs"]
FORCES = _TOLD["forces"]


def settings(model: str, table: pd.DataFrame) -> pd.DataFrame:
    """The six settings, our forces and the printed ones; a row per setting and person.

    Args:
        model: ``sf`` or ``nn``.
        table: of :func:`nnode.plots.settings.six_settings`.

    Returns:
        Indexed by setting and person: ``place (m)``, ``velocity (m/s)``, ``F_x``, ``F_y``,
        ``F_x printed``, ``F_y printed`` (N).
    """
    rows = {}
    for (_, row), printed in zip(table.iterrows(), FORCES[model], strict=True):
        for person, theirs in zip(("blue", "red"), printed, strict=True):
            place, velocity = row[f"x_{person}"], row[f"v_{person}"]
            force = row[f"force_{person}"]
            rows[(row["setting"], person)] = {
                "place (m)": f"({place[0]:g}; {place[1]:g})",
                "velocity (m/s)": f"({velocity[0]:g}; {velocity[1]:g})",
                "F_x": force[0],
                "F_x printed": theirs[0],
                "F_y": force[1],
                "F_y printed": theirs[1],
            }
    found = pd.DataFrame(rows).T.rename_axis(["setting", "person"])
    forces = [name for name in map(str, found) if name.startswith("F_")]
    return found.astype(dict.fromkeys(forces, float))
