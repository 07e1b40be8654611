"""Artificial recordings with known laws, in the raw formats of the real ones.

They are simulated with right-hand sides and a solver of their own, so that what is calibrated
on them is checked against something independent of the package's models and solvers.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from nnode.data.synthetic.crowd import Forces, crowd_recording, social_force
from nnode.data.synthetic.platoons import SlowZone, platoon_table
from nnode.data.synthetic.traffic import traffic_recording

__all__ = [
    "Forces",
    "SlowZone",
    "crowd_recording",
    "demo_data",
    "platoon_table",
    "social_force",
    "traffic_recording",
]


def demo_data(folder: Path | str, seed: int = 0, platoons: int = 20) -> dict[str, Path]:
    """Write the demonstration's recordings: two tables of platoons, and a small traffic and a small
    crowd recording that are laid out like the real data.

    Args:
        folder: receives ``platoons.csv``, the same platoons without the slow zone in
            ``nothing_hidden.csv``, ``esimas/sequence_datademo.mat`` and
            ``juelich/demo_corridor.txt``; ``data.source`` may point at it.
        seed: the same seed gives the same bytes.
        platoons: number of platoons in each table.

    Returns:
        The paths by data set: ``table``, ``nothing_hidden``, ``esimas`` and ``juelich``.
    """
    folder = Path(folder)
    traffic = folder / "esimas" / "sequence_datademo.mat"
    crowd = folder / "juelich" / "demo_corridor.txt"
    table = partial(platoon_table, seed=seed, platoons=platoons, cars=4, duration=20.0)
    return {
        "table": table(folder / "platoons.csv"),
        "nothing_hidden": table(folder / "nothing_hidden.csv", truth=SlowZone(alpha=1.0)),
        "esimas": traffic_recording(traffic, seed=seed),
        # several times longer than anyone stays, so that a block of it can be held out
        "juelich": crowd_recording(crowd, seed=seed, people=45, duration=36.0),
    }
