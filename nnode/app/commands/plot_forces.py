"""Plot the forces or speed curves of calibrated models.

Examples:
  nnode plot_forces checkpoint=RUN/checkpoints/best.pt
  # several models of traffic in one figure
  nnode plot_forces 'checkpoint=[A/checkpoints/best.pt,B/checkpoints/best.pt]'
  # a crowd's force within 2 m
  nnode plot_forces checkpoint=RUN/checkpoints/best.pt extent=2

Results: traffic, forces.png and forces.csv; crowds, contours of both components of the force and
the six settings of the paper. The histogram of gaps is that of the first checkpoint's data.
"""

from __future__ import annotations

from functools import partial

from nnode.app.cli.run import run
from nnode.app.cli.saved import saved_groups
from nnode.app.forces import plot_forces


def main() -> None:
    """Run this command on the options of the command line."""
    run("plot_forces", plot_forces, partial(saved_groups, option="checkpoint", groups=("data",)))
