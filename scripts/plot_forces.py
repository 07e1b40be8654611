"""Force plots of one or many calibrated models.

python scripts/plot_forces.py checkpoint=RUN/checkpoints/best.pt
python scripts/plot_forces.py checkpoint=[A/checkpoints/best.pt,B/checkpoints/best.pt]
"""

from functools import partial

from nnode.app.cli import run
from nnode.app.forces import plot_forces
from nnode.app.saved import saved_groups

if __name__ == "__main__":
    run("plot_forces", plot_forces, partial(saved_groups, option="checkpoint", groups=("data",)))
