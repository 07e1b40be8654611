"""Convert raw recordings to sequences, with a manifest of what was kept and dropped.

Other commands do this implicitly. This command stores the result, so that it can be inspected.

Examples:
  # the paper's traffic data, downloaded or from the folder in NNODE_DATA
  nnode prepare_data data=esimas
  nnode prepare_data data=juelich data.source=FOLDER_OR_URL
  # your own files
  nnode prepare_data data=table data.path=mine.csv data.domain=traffic
  nnode prepare_data data=vehicles data.path=FILE 'data.columns={vehicle: id, x: pos}'
  nnode prepare_data data=ngsim data.path=FILE
  nnode prepare_data data=pairs data.path=FOLDER 'data.columns={time: t, spacing: gap}'
  nnode prepare_data data=sumo data.path=fcd.xml

Results: the sequences, manifest.json, and figures of sequences with faults. Train with
data.prepared=FOLDER, without other options of the data.
"""

from __future__ import annotations

from nnode.app.cli.run import run
from nnode.app.prepare import prepare_data


def main() -> None:
    """Run this command on the options of the command line."""
    run("prepare_data", prepare_data)
