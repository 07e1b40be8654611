"""Predict drivers from the first seconds of their paths, with bands.

Examples:
  # held-out followers from their first 3 s, beside the typical driver
  nnode predict run=RUN
  nnode predict run=RUN seconds=10 part=all
  # other data than those of the run
  nnode predict run=RUN data=table data.path=drive.csv data.domain=traffic

Results: prediction.csv with a row per follower and sample, prediction.json with errors and the
coverage of the bands, prediction.png. The run must be a training with drivers who differ
(trainer.drivers=auto); vehicles ahead move as measured.
"""

from __future__ import annotations

from functools import partial

from nnode.app.cli.run import run
from nnode.app.cli.saved import saved_groups
from nnode.app.predict import predict


def main() -> None:
    """Run this command on the options of the command line."""
    run("predict", predict, partial(saved_groups, option="run", groups=("data",)))
