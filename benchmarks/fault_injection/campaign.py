"""What campaigns on jobs share: which jobs, one after the other, and what is left behind."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Collection
from pathlib import Path

from benchmarks.fault_injection.jobs import Job, jobs, load_libraries
from benchmarks.fault_injection.report import Row
from nnode.errors import ConfigError
from nnode.progress import Stages

#: A job, its folder, and who is told which part of it is done.
Work = Callable[[Job, Path, Callable[[float], None]], list[Row]]


def on_jobs(
    folder: Path,
    name: str,
    title: str,
    plan: Callable[[list[Job]], tuple[list[float], Work]],
    names: list[str] | None = None,
    but: Collection[str] = (),
) -> list[Row]:
    """Test one job after the other.

    Args:
        folder: of all campaigns; what this one writes is removed where nothing was lost.
        name: of the campaign.
        title: of its bar.
        plan: of the chosen jobs, how long each takes, relative to the others, and what is done.
        names: of the jobs; None takes all, except those in ``but``.

    Raises:
        ConfigError: an unknown job.
    """
    scratch = folder / name
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    load_libraries()
    known = jobs(scratch / "raw")
    all_names = [job.name for job in known]
    check_names("jobs", names or [], all_names)
    wanted = [job for job in all_names if job not in but] if names is None else names
    chosen = [job for job in known if job.name in wanted]
    rows: list[Row] = []
    costs, work = plan(chosen)
    parts = dict(zip((job.name for job in chosen), costs, strict=True))
    with Stages(title, parts, forks=True) as stages:
        for job in chosen:
            stages.begin(job.name)
            place = scratch / job.name
            place.mkdir()
            rows += work(job, place, stages.within)
    if not any(row.losses for row in rows):
        shutil.rmtree(scratch)
    return rows


def check_names(option: str, names: Collection[str], known: Collection[str]) -> None:
    """Refuse names that there are not.

    Raises:
        ConfigError: with the names that there are.
    """
    strange = sorted(set(names) - set(known))
    if strange:
        raise ConfigError(f"{option}: {strange[0]} is unknown, expected some of {', '.join(known)}")
