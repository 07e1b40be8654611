"""Repeat the paper's studies on the real recordings, with a page that compares printed numbers.

Examples:
  nnode study study=traffic
  # a test of one minute, whose numbers are not results
  nnode study study=crowd study.quick=true
  # pairs and platoons that the study cannot download: a folder with ngsim_pairs, openacc, tgsim
  NNODE_DATA=FOLDER nnode study study=following
  nnode study study=traffic study.workers=8 hydra.run.dir=runs/study/mine

Results: study.html, the same in Markdown, and a CSV of every table and of all parameters. The same
command continues a stopped study.
"""

from __future__ import annotations

from nnode.app.cli.run import run
from studies.command import study


def main() -> None:
    """Run this command on the options of the command line."""
    run("study", study)
