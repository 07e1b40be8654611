"""Misuse on purpose: kills, full disks, two runs in one folder, malformed files.

Examples:
  # everything: hours
  python scripts/fault_injection.py
  python scripts/fault_injection.py 'campaigns=[kills]' kills=50 'jobs=[train,study]'
  python scripts/fault_injection.py 'campaigns=[fuzz]' inputs=10000 \\
      'targets=[juelich,esimas]' seed=7

Results: one table and report.json; the exit status is not 0 where anything was lost.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the benchmarks are not installed

from benchmarks.config import register
from benchmarks.fault_injection.run import fault_injection
from nnode.app.cli.run import run

if __name__ == "__main__":
    register()
    run("fault_injection", fault_injection)
