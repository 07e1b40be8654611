"""What halving and doubling each number of the rules does: names, false names, unknowns.

``python -m benchmarks.discovery.sensitivity FOLDER --seeds-of HASH``; without it seeds begin at
--first-seed and are development. Of a number near 1 the distance to 1 is halved and doubled. What
is done is kept in the folder and not computed again.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.discovery.task import diagnose_case, sources
from benchmarks.synthetic_cases.arms import cases, first_seed
from benchmarks.synthetic_cases.score import UNKNOWN
from nnode.discover.rules import Rules
from studies.runner import Task, run_tasks


def settings() -> Iterator[tuple[str, dict[str, float]]]:
    """Names of changes with the numbers that they change; the rules as they are first."""
    yield "as they are", {}
    for one in fields(Rules):
        usual = getattr(Rules(), one.name)
        for word, factor in (("halved", 0.5), ("doubled", 2.0)):
            near_one = 0.5 < usual < 1
            value = 1 - factor * (1 - usual) if near_one else factor * usual
            # half of all is no share: the distance to 1 is halved instead
            value = value if one.name == "prior" or value < 1 else (1 + usual) / 2
            yield f"{one.name} {word}", {one.name: value}


def table(results: dict[str, dict[str, Any]]) -> pd.DataFrame:
    """A row per change: counts over the cases that all changes have in common."""
    frame = pd.DataFrame(list(results.values()))
    something = frame["arm"] == "single"
    rows = []
    for word, changed in settings():
        part = frame[frame["changed"] == word]
        single, outside = part[something], part[~something]
        rows.append(
            {
                "rule": word,
                "value": next(iter(changed.values()), None),
                "single": len(single),
                "exact": int(single["exact"].sum()),
                "among_equals": int(single["among_equals"].sum()),
                "false_names": int(part["false_names"].map(bool).sum()),
                "outside": len(outside),
                "outside_unknown": int((outside["verdict"] == UNKNOWN).sum()),
                "single_unknown": int((single["verdict"] == UNKNOWN).sum()),
            }
        )
    return pd.DataFrame(rows)


def one_change(change: str, **arguments: Any) -> dict[str, Any]:
    """The score of a case under changed rules."""
    return {**diagnose_case(**arguments), "changed": change}


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.discovery.sensitivity", description=__doc__
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds-of", help="full hash of a commit")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--domain", default="traffic", choices=["traffic", "crowd"])
    parser.add_argument("--sequences", type=int, default=40)
    parser.add_argument("--every", type=int, default=1, help="takes each so many-th case only")
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    seed = given.first_seed if given.seeds_of is None else first_seed(given.seeds_of)
    hidden = [
        case
        for arm in ("single", "outside")
        for case in cases(given.domain, arm, seeds=[seed], sizes=[given.sequences])[:: given.every]
    ]
    tasks = [
        Task(
            f"{case.key}-{change.replace(' ', '-')}",
            one_change,
            {"change": change, "case": case.to_dict(), "seeds_of": given.seeds_of, "rules": rules},
        )
        for change, rules in settings()
        for case in hidden
    ]
    results = run_tasks(
        tasks, given.folder, workers=given.workers, fingerprint=sources(), title="diagnoses"
    )
    found = table(results)
    found.to_csv(given.folder / "sensitivity.csv", index=False)
    print(found.to_string(index=False))


if __name__ == "__main__":
    main()
