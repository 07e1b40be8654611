"""A run's results in the formats of other programs.

python scripts/export.py run=RUN                        # all that fit the run's model
python scripts/export.py run=RUN to=jupedsim
python scripts/export.py run=RUN to=[pedpy,parquet] trajectories=simulated part=heldout
"""

from nnode.app.cli import run
from nnode.app.export import export, groups_of_run

if __name__ == "__main__":
    run("export", export, groups_of_run)
