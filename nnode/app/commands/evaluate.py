"""Compute the errors of a calibrated model and of baselines.

Examples:
  # on the sequences that its training held out
  nnode evaluate checkpoint=RUN/checkpoints/best.pt
  # on other data
  nnode evaluate checkpoint=RUN/checkpoints/best.pt data=esimas data.recording=2-1_1
  nnode evaluate checkpoint=RUN/checkpoints/best.pt part=all

Results: a table, metrics.json, and replay.html, an animation. Data and solver are those of the
training by default.
"""

from __future__ import annotations

from functools import partial

from nnode.app.cli.run import run
from nnode.app.cli.saved import saved_groups
from nnode.app.evaluate import evaluate_checkpoint


def main() -> None:
    """Run this command on the options of the command line."""
    run(
        "evaluate",
        evaluate_checkpoint,
        partial(saved_groups, option="checkpoint", groups=("data", "solver")),
    )
