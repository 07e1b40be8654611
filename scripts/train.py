"""Calibrate a model to measured trajectories.

python scripts/train.py model=n4 data=esimas data.recording=1-1_1
python scripts/train.py -m model=lin,log,n2 seed=1,2,3
python scripts/train.py -m hydra/launcher=cores model=lin,log,n2
torchrun --nproc-per-node=2 scripts/train.py model=n4 data=esimas data.recording=1-1_1
python scripts/train.py resume=RUN/checkpoints/last.pt hydra.run.dir=RUN
"""

from functools import partial

from nnode.app.cli import run
from nnode.app.saved import saved_groups
from nnode.app.train import train

if __name__ == "__main__":
    run("train", train, partial(saved_groups, option="resume"), parallel=True)
