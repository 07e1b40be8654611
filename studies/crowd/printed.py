"""Numbers printed in section 6 of Göttlich & Totzeck, to be set beside ours."""

from __future__ import annotations

import pandas as pd

#: Estimated parameters of the social force: A (N), k (kg/s²), kappa (kg/(m s)).
PARAMETERS = {"A": 0.0044, "k": 34.9539, "kappa": 9.8894}

#: Mean cost of a sequence of 1 s without the time step, m².
COSTS = {"sf": 5.0841, "nn": 5.5979}

#: Tables (data6settings) and (data6settingsNN): forces on blue and on red in settings 1 to 6, N.
FORCES = {
    "sf": (
        ((0.0, 2.1118), (0.0, -2.1118)),
        ((0.0, 2.1118), (0.0, -2.1118)),
        ((0.0417, 2.0961), (-0.0417, -2.0961)),
        ((0.0952, 2.0936), (-0.0952, -2.0936)),
        ((2.1118, 1.1867), (-2.1118, -1.1867)),
        ((2.1118, 0.0), (-2.1118, 0.0)),
    ),
    "nn": (
        ((0.1794, 0.1517), (-0.2230, -0.1856)),
        ((0.4607, 0.7512), (-0.2557, -1.0052)),
        ((0.1782, 0.1496), (-0.2218, -0.1858)),
        ((0.4602, 0.7487), (-0.2539, -1.0055)),
        ((0.1742, -0.7027), (0.5133, 0.8687)),
        ((0.4605, -0.2639), (0.5612, -0.1540)),
    ),
}


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
        for person, told in zip(("blue", "red"), printed, strict=True):
            place, velocity = row[f"x_{person}"], row[f"v_{person}"]
            force = row[f"force_{person}"]
            rows[(row["setting"], person)] = {
                "place (m)": f"({place[0]:g}; {place[1]:g})",
                "velocity (m/s)": f"({velocity[0]:g}; {velocity[1]:g})",
                "F_x": force[0],
                "F_x printed": told[0],
                "F_y": force[1],
                "F_y printed": told[1],
            }
    found = pd.DataFrame(rows).T.rename_axis(["setting", "person"])
    forces = [name for name in map(str, found) if name.startswith("F_")]
    return found.astype(dict.fromkeys(forces, float))
