"""Artificial recordings with known laws, in the raw formats of the real ones.

They are simulated with right-hand sides and a solver of their own, so that what is calibrated
on them is checked against something independent of the package's models and solvers.
"""

from __future__ import annotations

from pathlib import Path

from nnode.data.synthetic.crowd import Forces, crowd_recording, social_force
from nnode.data.synthetic.platoons import SlowZone, platoon_table
from nnode.data.synthetic.traffic import traffic_recording
from nnode.data.synthetic.truth import TRAFFIC

__all__ = [
    "Forces",
    "SlowZone",
    "crowd_recording",
    "demo_data",
    "platoon_table",
    "social_force",
    "traffic_recording",
]


def demo_data(folder: Path | str, seed: int = 0) -> dict[str, Path]:
    """Write a small traffic and a small crowd recording, laid out like the real data, and a table
    of platoons for the diagnosis.

    Args:
        folder: receives ``esimas/sequence_datademo.mat`` and ``juelich/demo_corridor.txt``;
            ``data.source`` may point at it. ``platoons.csv`` is read with ``data=table``.
        seed: the same seed gives the same bytes.

    Returns:
        The paths by data set, ``esimas``, ``juelich`` and ``table``.
    """
    folder = Path(folder)
    traffic = folder / "esimas" / "sequence_datademo.mat"
    crowd = folder / "juelich" / "demo_corridor.txt"
    return {
        "esimas": traffic_recording(traffic, seed=seed, v0=TRAFFIC["v0"], L=TRAFFIC["L"]),
        # several times longer than anyone stays, so that a block of it can be held out
        "juelich": crowd_recording(crowd, seed=seed, people=45, duration=36.0),
        "table": platoon_table(folder / "platoons.csv", seed=seed),
    }
