"""Worlds that nobody who wrote the diagnosis made: ``python -m benchmarks.open_world FOLDER``.

--seeds-of HASH takes the seeds of the commit that froze the rules; without it they begin at
--first-seed and are development. What is done is kept in the folder and not computed again.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from benchmarks.discovery.task import sources
from benchmarks.open_world import by_jupedsim, by_sumo, laws
from benchmarks.open_world.page import write
from benchmarks.synthetic_cases.arms import first_seed
from studies.runner import Task, run_tasks


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.open_world", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds-of", help="full hash of a commit")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--number", type=int, default=5, help="worlds of every law")
    parser.add_argument("--scenes", type=int, default=2, help="of every kind, by SUMO and JuPedSim")
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    seed = given.first_seed if given.seeds_of is None else first_seed(given.seeds_of)
    tasks = [
        Task(f"{one['law']}-{one['asked']}-s{one['seed']}", laws.diagnosed_case, one)
        for one in laws.cases(seed, given.number)
    ]
    tasks += [
        Task(f"{one['scene']}-s{one['seed']}", by_sumo.diagnosed_scene, one)
        for one in by_sumo.cases(seed, given.scenes)
    ]
    tasks += [
        Task(f"people-{one['scene']}-s{one['seed']}", by_jupedsim.diagnosed_people, one)
        for one in by_jupedsim.cases(seed, given.scenes)
    ]
    found = run_tasks(
        tasks, given.folder, workers=given.workers, fingerprint=sources(), title="worlds"
    )
    for path in write(list(found.values()), given.seeds_of, given.folder):
        print(path)


if __name__ == "__main__":
    main()
