"""Export a run's results to the formats of other programs.

Examples:
  # all formats that fit the run's model
  nnode export run=RUN
  # the social force's parameters for JuPedSim, a law's for SUMO
  nnode export run=RUN to=jupedsim
  nnode export run=RUN 'to=[pedpy,parquet]' trajectories=simulated part=heldout

Results: the files, and a list of parts of the model without a counterpart; see docs/exchange.md.
Data are those of the run by default.
"""

from __future__ import annotations

from functools import partial

from nnode.app.cli.run import run
from nnode.app.cli.saved import saved_groups
from nnode.app.export import export


def main() -> None:
    """Run this command on the options of the command line."""
    run("export", export, partial(saved_groups, option="run", groups=("data", "solver")))
