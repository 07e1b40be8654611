"""Find what a model lacks: where it is wrong, which effect is missing, what adding it changes.

python scripts/discover.py model=lin data=esimas
python scripts/discover.py model=lin model.leader=measured data=table data.path=F.csv \\
    data.domain=traffic
python scripts/discover.py model=sf data=table data.path=F.csv data.domain=crowd data.walls=W.csv
python scripts/discover.py model=lin data=ngsim discover.exclude=[inertia] hydra.run.dir=DIR

Ends with report.json, report.html, and the extended model as configuration and checkpoint.
"""

from nnode.app.cli import run
from nnode.app.discover import discover

if __name__ == "__main__":
    run("discover", discover)
