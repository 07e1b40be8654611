"""Motion sampled from a calibrated model, with its noise and its drivers or walkers.

Examples:
  # what the run held out, 99 times, scored beside the model without noise and constant speeds
  nnode simulate run=RUN
  nnode simulate run=RUN samples=399 seed=1
  # the samples as SUMO or PedPy have trajectories; scores alone
  nnode simulate run=RUN format=fcd
  nnode simulate run=RUN format=pedpy
  nnode simulate run=RUN format=null

Results: scores.json, the noise, CRPS and what bands cover; bands.png; samples.parquet, which
data=table reads, of people with walls.csv. docs/sampling.md has the other formats and how noise is
fitted. Data are those of the run.
"""

from __future__ import annotations

from nnode.app.cli.run import run
from nnode.app.export import groups_of_run
from nnode.app.simulate import simulate


def main() -> None:
    """Run this command on the options of the command line."""
    run("simulate", simulate, groups_of_run)
