"""Errors of a calibrated model beside its baselines.

python scripts/evaluate.py checkpoint=RUN/checkpoints/best.pt
python scripts/evaluate.py checkpoint=RUN/checkpoints/best.pt data=esimas data.recording=2-1_1
"""

from functools import partial

from nnode.app.cli import run
from nnode.app.evaluate import evaluate_checkpoint
from nnode.app.saved import saved_groups

if __name__ == "__main__":
    run(
        "evaluate",
        evaluate_checkpoint,
        partial(saved_groups, option="checkpoint", groups=("data", "solver")),
    )
