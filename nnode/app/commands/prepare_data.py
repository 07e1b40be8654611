"""Turn raw recordings into sequences, with a manifest of everything kept and dropped.

Other commands do so on the fly; this one does it once, to look at what became of the files.

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

Results: the sequences, manifest.json, and pictures of those with faults. Train with
data.prepared=FOLDER, and no other option of the data.
"""

from __future__ import annotations

from nnode.app.cli.run import run
from nnode.app.prepare import prepare_data


def main() -> None:
    """Run this command on the options of the command line."""
    run("prepare_data", prepare_data)
