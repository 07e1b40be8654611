"""``python -m nnode.data.synthetic FOLDER``: write the demonstration's recordings.

``python -m nnode.data.synthetic --compare RUNS``: what its runs found, beside the truth.
"""

from __future__ import annotations

import sys

from nnode.data.synthetic import demo_data
from nnode.data.synthetic.truth import beside_truth
from nnode.errors import NNodeError

match sys.argv[1:]:
    case ["--compare", folder]:
        try:
            print(beside_truth(folder))
        except NNodeError as error:
            sys.exit(f"error: {error}")
    case [folder] if not folder.startswith("-"):
        for path in demo_data(folder).values():
            print(f"recording: {path}")
    case _:
        sys.exit("usage: python -m nnode.data.synthetic FOLDER | --compare RUNS")
