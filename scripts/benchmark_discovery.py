"""Diagnose cases with a known truth, and score the diagnosis.

Examples:
  # everything: hours
  python scripts/benchmark_discovery.py
  # a part of it
  python scripts/benchmark_discovery.py 'benchmark_discovery.domains=[traffic]' \\
      'benchmark_discovery.arms=[single,nothing]' benchmark_discovery.seeds=3
  # against noise and number of sequences
  python scripts/benchmark_discovery.py 'benchmark_discovery.domains=[traffic]' \\
      'benchmark_discovery.arms=[single]' 'benchmark_discovery.noises=[0,0.05,0.3]' \\
      'benchmark_discovery.sizes=[5,20,80]'
  # how often chance passes where nothing is hidden, on seeds that follow from a commit
  python scripts/benchmark_discovery.py 'benchmark_discovery.arms=[nothing]' \\
      'benchmark_discovery.variants=[white,windows]' benchmark_discovery.nothing_seeds=400 \\
      benchmark_discovery.seeds_of=0000000000000000000000000000000000000000

  # laws written by hand and scenes of SUMO and JuPedSim; advice; parameters typed into programs
  python scripts/benchmark_discovery.py 'benchmark_discovery.kinds=[laws,sumo,jupedsim]' \\
      benchmark_discovery.seeds=2
  python scripts/benchmark_discovery.py 'benchmark_discovery.kinds=[advice,recovery]'

Results: a page with tables over all cases that the folder holds. The same command continues a
stopped run.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the benchmarks are not installed

from benchmarks.config import register
from benchmarks.discovery.run import benchmark_discovery
from nnode.app.cli.run import run

if __name__ == "__main__":
    register()
    run("benchmark_discovery", benchmark_discovery)
