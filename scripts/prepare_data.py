"""Turn raw recordings into sequences, with a manifest of everything kept and dropped.

python scripts/prepare_data.py data=esimas
python scripts/prepare_data.py data=juelich data.source=FOLDER_OR_URL
python scripts/prepare_data.py data=ngsim data.path=FILE
"""

from nnode.app.cli import run
from nnode.app.prepare import prepare_data

if __name__ == "__main__":
    run("prepare_data", prepare_data)
