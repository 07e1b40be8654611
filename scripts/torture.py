"""Misuse on purpose: kills, full disks, two runs in one folder, malformed files.

Examples:
  # everything: hours
  python scripts/torture.py
  python scripts/torture.py 'campaigns=[kills]' kills=50 'jobs=[train,study]'
  python scripts/torture.py 'campaigns=[fuzz]' inputs=10000 'targets=[juelich,esimas]' seed=7

Results: one table and report.json; the exit status is not 0 where anything was lost.
"""

from nnode.app.cli import run
from nnode.app.torture import torture

if __name__ == "__main__":
    run("torture", torture)
