"""Find what a model lacks: where it is wrong, which effect is missing, what adding it changes.

Examples:
  nnode discover model=lin data=esimas
  # your own tables: columns sequence, time, agent, x and, in crowds, y; in SI units
  nnode discover model=lin model.leader=measured data=table data.path=F.csv \\
      data.domain=traffic
  nnode discover model=sf data=table data.path=F.csv data.domain=crowd data.walls=W.csv
  # without one effect, in a folder of your choice
  nnode discover model=lin data=ngsim 'discover.exclude=[inertia]' hydra.run.dir=DIR

Networks (model=n2, n4, n10, nn) can represent effects of their inputs: diagnose a law to find
them. python -m nnode.diagnosis.catalogue lists the effects with formulas, units and sources.

Results: report.html, report.json, and the extended model as model.yaml and checkpoints/best.pt;
docs/discovery.md explains them, and how to write your own effect.
"""

from __future__ import annotations

from nnode.app.cli.run import run
from nnode.app.discover import discover


def main() -> None:
    """Run this command on the options of the command line."""
    run("discover", discover)
