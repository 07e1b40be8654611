"""The paper's studies: ``nnode study``."""

from __future__ import annotations

import logging
import time
from importlib import import_module
from pathlib import Path
from typing import Protocol, cast

from omegaconf import DictConfig, OmegaConf

from nnode.calibrate.interrupt import BreakingGuard
from nnode.errors import unknown_value
from nnode.machine import cores, how_made
from nnode.pages.page import Block, Provenance, write_page
from studies.options import StudyOptions, checked
from studies.runner import KEPT

log = logging.getLogger(__name__)

#: The module of each study; imported when it is asked for.
STUDIES = {
    name: f"studies.{name}.study"
    for name in ("traffic", "crowd", "following", "walking", "prediction")
}

#: Folder of quick studies inside the study's own: they must not replace full results.
QUICK = "quick"

_PACKAGES = ("torch", "numba", "numpy", "scipy", "pandas", "matplotlib")


class Study(Protocol):
    """A module that makes a page.

    Attributes:
        TITLE: of the page.
        SUBTITLE: one sentence in Markdown.
    """

    TITLE: str
    SUBTITLE: str

    @staticmethod
    def run(options: StudyOptions, folder: Path) -> list[Block]:
        """Compute what is not kept in ``folder`` yet, and make the page's blocks.

        Args:
            options: checked; ``workers`` is a number.
            folder: of this study; its results are kept there.
        """
        ...


def study(config: DictConfig, folder: Path) -> None:
    """Run a study, write its page, tables and figures, and print where they are.

    Raises:
        ConfigError: an unknown study, or options that it cannot work with.
        Interrupted: a signal asked to stop; what is done is kept.
    """
    options = cast(StudyOptions, OmegaConf.to_object(config.study))
    if options.name not in STUDIES:
        raise unknown_value("study.name", options.name, STUDIES)
    options = checked(options)
    options.workers = options.workers or cores()
    folder = folder / QUICK if options.quick else folder
    start, before = time.monotonic(), len(list((folder / KEPT).glob("*.json")))
    with BreakingGuard(f": what is done is kept in {folder}; the same command goes on from there"):
        module = cast(Study, import_module(STUDIES[options.name]))
        blocks = module.run(options, folder)
        made = _made(time.monotonic() - start, options.workers, before)
        paths = write_page(
            [*blocks, made],
            folder,
            title=module.TITLE + (" (quick)" if options.quick else ""),
            subtitle=module.SUBTITLE,
        )
    for path, what in zip(paths, ("page", "as Markdown"), strict=False):
        print(f"{what}: {path}")
    print(f"tables: {sum(p.suffix == '.csv' for p in paths)} CSV files in {folder}")
    print(f"time: {time.monotonic() - start:.1f} s")


def _made(seconds: float, workers: int, before: int) -> Provenance:
    """How this run made the page, and how many results an earlier one had left."""
    facts = how_made(_PACKAGES)
    time_taken = f"{seconds:.0f} s in this run with {workers} worker process(es), which " + (
        f"went on from {before} results of earlier ones" if before else "began with no results"
    )
    return Provenance({**facts, "Time": time_taken})
