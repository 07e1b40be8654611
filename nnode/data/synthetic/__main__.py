"""``python -m nnode.data.synthetic FOLDER``: write the demonstration's recordings."""

from __future__ import annotations

import sys

from nnode.data.synthetic import demo_data

if len(sys.argv) != 2 or sys.argv[1].startswith("-"):
    sys.exit("usage: python -m nnode.data.synthetic FOLDER")
for path in demo_data(sys.argv[1]).values():
    print(f"recording: {path}")
