"""A study of squares, for tests of the runner and the command."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from nnode.pages.page import Block, TableBlock
from studies.options import StudyOptions
from studies.runner import run_tasks
from tests.studies import work

TITLE = "Squares"
SUBTITLE = "Of *two* numbers."


def run(options: StudyOptions, folder: Path) -> list[Block]:
    """Compute two squares and run two sleeping tasks."""
    assert options.workers is not None
    folder.mkdir(parents=True, exist_ok=True)
    outcome = run_tasks(
        work.tasks(folder), folder, workers=options.workers, fingerprint="f", title="tiny"
    )
    squares = {key: result["y"] for key, result in outcome.items() if "y" in result}
    return [TableBlock("squares", pd.Series(squares, name="y").to_frame(), "Squares.")]
