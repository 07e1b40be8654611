"""Redo the paper's studies on the real recordings; ends with one page beside its printed numbers.

python scripts/study.py study=traffic
python scripts/study.py study=crowd study.quick=true
python scripts/study.py study=traffic study.workers=8 hydra.run.dir=runs/study/mine

The same command goes on where it was stopped.
"""

from nnode.app.cli import run
from nnode.app.study import study

if __name__ == "__main__":
    run("study", study)
