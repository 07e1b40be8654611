"""Time all engines on the same problems, after checking that they agree.

Examples:
  python scripts/benchmark.py
  python scripts/benchmark.py 'benchmark.shapes=[stress]' benchmark.repeats=3
  python scripts/benchmark.py 'benchmark.shapes=[paper]' 'benchmark.engines=[odeint,fused_1]'

Results: tables, benchmark.json, and benchmark.png where there is enough to draw.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the benchmarks are not installed

from benchmarks.config import register
from benchmarks.speed.run import benchmark
from nnode.app.cli.run import run

if __name__ == "__main__":
    register()
    run("benchmark", benchmark)
