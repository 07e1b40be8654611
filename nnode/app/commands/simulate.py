"""Sample motion from a calibrated model, with noise and random drivers or pedestrians.

Examples:
  # 99 samples of held-out sequences, scored with the model without noise and constant speeds
  nnode simulate run=RUN
  nnode simulate run=RUN samples=399 seed=1
  # the samples in the formats of SUMO or PedPy; only scores
  nnode simulate run=RUN format=fcd
  nnode simulate run=RUN format=pedpy
  nnode simulate run=RUN format=null

Results: scores.json with the noise, CRPS and the coverage of bands; bands.png; samples.parquet,
which data=table reads, for pedestrians with walls.csv. docs/sampling.md explains other formats and
the fit of the noise. Data are those of the run.
"""

from __future__ import annotations

from functools import partial

from nnode.app.cli.run import run
from nnode.app.cli.saved import saved_groups
from nnode.app.simulate import simulate


def main() -> None:
    """Run this command on the options of the command line."""
    run("simulate", simulate, partial(saved_groups, option="run", groups=("data", "solver")))
