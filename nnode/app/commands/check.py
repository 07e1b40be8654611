"""Check the content of a file of trajectories before using it.

The check covers columns, units, sampling rate and time scale, identifiers, swaps, overlaps, gaps in
time, direction, order, arrivals and departures. It states the certainty of what it recognises, and
the options with which the other commands read the file.

Examples:
  nnode check mine.csv
  # known options are not guessed
  nnode check people.txt domain=crowd frame_rate=25

Results: a text, and check.html, a page that needs no other file. Nothing is changed.
"""

from __future__ import annotations

from nnode.app.check import check
from nnode.app.cli.run import run


def main() -> None:
    """Run this command on the options of the command line."""
    run("check", check, bare="file")
