"""What a file of trajectories holds and what is wrong with it, before anything else.

Columns, units, rate and time scale, identifiers, swaps, overlaps, holes, direction, order, who
comes and goes, how sure all that is, and the options with which the other commands read the file.

Examples:
  nnode check mine.csv
  # what is known need not be guessed
  nnode check people.txt domain=crowd frame_rate=25

Results: a text, and check.html, a page that needs no other file. Nothing is changed.
"""

from __future__ import annotations

from nnode.app.check import check
from nnode.app.cli.run import run


def main() -> None:
    """Run this command on the options of the command line."""
    run("check", check, bare="file")
