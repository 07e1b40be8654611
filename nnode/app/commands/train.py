"""Calibrate a model to measured trajectories.

Examples:
  # one of the paper's recordings and its network with four neurons
  nnode train model=n4 data=esimas data.recording=1-1_1
  # compiled kernels and L-BFGS: a hundred times faster
  nnode train model=lin data=esimas solver=fused optimizer=lbfgs
  # car-following laws, by the Gauss-Newton method with exact derivatives
  nnode train model=idm data=ngsim_pairs trainer.cost=spacing
  # differences between drivers: which parameters differ, their variance, and each driver's values
  nnode train model=idm data=openacc trainer.drivers=auto
  # your own table: columns sequence, time, agent, x; in SI units
  nnode train model=lin data=table data.path=mine.csv data.domain=traffic
  # sweeps: every model with every seed, one after the other, or on all cores
  nnode train -m model=lin,log,n2 seed=1,2,3
  nnode train -m hydra/launcher=cores model=lin,log,n2
  # mini-batches shared by two processes
  torchrun --nproc-per-node=2 -m nnode train model=n4 data=esimas data.recording=1-1_1
  # continue a stopped run
  nnode train resume=RUN/checkpoints/last.pt hydra.run.dir=RUN

Results: result.json, checkpoints/best.pt and last.pt, and curves for TensorBoard; with
trainer.drivers also drivers.csv. A sweep ends with sweep.csv. Ctrl-C saves the state, and prints
the command that continues the run.
"""

from __future__ import annotations

from nnode.app.cli.run import run
from nnode.app.cli.saved import train_groups
from nnode.app.train import train


def main() -> None:
    """Run this command on the options of the command line."""
    run("train", train, train_groups, parallel=True)
