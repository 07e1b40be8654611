"""Mutants of the package against its tests: ``python -m benchmarks.mutants.run``.

``mutants.csv`` is a fixed list of small faults (mutants): in the code of laws, the solvers, the
least squares, and the statistics. Cosmic Ray makes them. Each is put into a copy of the checkout,
where the tests of its room run until one fails. A mutant that no test notices survives. ``--draw``
draws a new list by ``--seed``. Cosmic Ray comes with ``pip install "nnode[bench]"``.
"""

from __future__ import annotations

import argparse
import ast
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Hashable, Iterator
from pathlib import Path
from typing import Any

import pandas as pd

from nnode.files import write_text

ROOT = Path(__file__).parents[2]
LIST = Path(__file__).with_name("mutants.csv")
#: Modules that get mutants, and the tests of their rooms.
ROOMS = {
    "nnode/population/*.py": "tests/population",
    "nnode/diagnosis/statistics/*.py": "tests/diagnosis/statistics",
    "nnode/calibrate/least_squares.py": "tests/calibrate",
    "nnode/calibrate/intervals.py": "tests/calibrate",
    "nnode/calibrate/resampling.py": "tests/calibrate",
    "nnode/generate/*.py": "tests/generate",
    "nnode/model/[!_]*.py": "tests/model",
    "nnode/model/laws/*.py": "tests/model",
    "nnode/simulation/linear.py": "tests/simulation",
    "nnode/simulation/numpy.py": "tests/simulation",
    "nnode/simulation/rhs.py": "tests/simulation",
}
#: Operators whose mutants are not faults: unions of types, decorators that only make code fast, and
#: exceptions of another type that nothing catches.
LEFT_OUT = ("BitOr", "RemoveDecorator", "ExceptionReplacer", "NoOp", "Variable")
#: s that the tests of a mutant may take.
LIMIT = 600


def mutants() -> pd.DataFrame:
    """All mutants: module, operator, number among those of the operator, function, line."""
    from cosmic_ray.commands import init
    from cosmic_ray.work_db import WorkDB

    paths, rows = {path for pattern in ROOMS for path in ROOT.glob(pattern)}, []
    with tempfile.TemporaryDirectory() as folder:
        database = WorkDB(str(Path(folder) / "mutants.sqlite"), WorkDB.Mode.create)
        init(sorted(paths), database, {})
        mutations = [mutation for item in database.work_items for mutation in item.mutations]
        database.close()
    for mutation in mutations:
        if any(name in mutation.operator_name for name in LEFT_OUT):
            continue
        module, line = mutation.module_path, mutation.start_pos[0]
        rows.append(
            {
                "module": module.relative_to(ROOT).as_posix(),
                "operator": mutation.operator_name,
                "occurrence": mutation.occurrence,
                "function": mutation.definition_name,
                "line": module.read_text(encoding="utf-8").splitlines()[line - 1].strip(),
            }
        )
    return pd.DataFrame(rows)


def outcome(mutant: dict[Hashable, Any], checkout: Path) -> str:
    """``killed``, ``survived``, ``slow`` beyond :data:`LIMIT`; ``gone`` if the line has changed, or
    ``invalid`` if the mutant is no Python, such as another sign for the ``*`` before keywords.

    Args:
        mutant: a row of the list. checkout: a copy of the repository.
    """
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator

    module = checkout / mutant["module"]
    text = module.read_text(encoding="utf-8")
    changed = mutate_code(text, get_operator(mutant["operator"])(), int(mutant["occurrence"])) or ""
    pairs = zip(text.splitlines(), changed.splitlines(), strict=False)
    if mutant["line"] not in [before.strip() for before, after in pairs if before != after]:
        return "gone"
    try:
        ast.parse(changed)
    except SyntaxError:
        return "invalid"
    module.write_text(changed, encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
    command += ["-m", "not slow and not tutorial"]
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    try:
        done = subprocess.run(
            [*command, *tests_of(mutant["module"])],
            cwd=checkout,
            env=environment,
            capture_output=True,
            timeout=LIMIT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return "slow"
    finally:
        module.write_text(text, encoding="utf-8")
    return "killed" if done.returncode else "survived"


def tests_of(module: str) -> list[str]:
    """The tests of a module: first ``test_MODULE.py``, if it exists, then all of its room."""
    path = Path(module)
    room = next(tests for pattern, tests in ROOMS.items() if path.match(pattern))
    name = path.parent.name if path.stem == "__init__" else path.stem
    own = Path(room) / f"test_{name}.py"
    return [own.as_posix(), room] if (ROOT / own).exists() else [room]


def outcomes(table: pd.DataFrame) -> Iterator[dict[Hashable, Any]]:
    """The rows with their outcomes."""
    with tempfile.TemporaryDirectory() as folder:
        checkout = Path(folder) / "checkout"
        ignored = shutil.ignore_patterns(".git", ".venv", "runs", "__pycache__")
        shutil.copytree(ROOT, checkout, ignore=ignored)
        for mutant in table.to_dict("records"):
            row = {**mutant, "outcome": outcome(mutant, checkout)}
            print(*row.values(), sep=", ", flush=True)
            yield row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draw", type=int, help="draw a new list of so many mutants")
    parser.add_argument("--seed", type=int, default=0, help="of a new list")
    parser.add_argument("--first", type=int, default=0, help="row to begin with")
    parser.add_argument("--number", type=int, help="number of rows; by default all")
    parser.add_argument("--table", type=Path, default=Path("runs/mutants.csv"))
    given = parser.parse_args()
    if given.draw:
        drawn = mutants().sample(given.draw, random_state=given.seed)
        write_text(LIST, str(drawn.to_csv(index=False)))
        return
    table = pd.read_csv(LIST).iloc[given.first :].head(given.number)
    rows = list[dict[Hashable, Any]]()
    for row in outcomes(table):
        rows.append(row)
        write_text(given.table, str(pd.DataFrame(rows).to_csv(index=False)))
    print(pd.DataFrame(rows)["outcome"].value_counts().to_string())


if __name__ == "__main__":
    main()
