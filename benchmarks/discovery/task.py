"""One case of the benchmark of the diagnosis: generate, diagnose, score."""

from __future__ import annotations

import hashlib
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import nnode
from benchmarks.synthetic_cases import TABLE, WALLS, Case, generate
from benchmarks.synthetic_cases.score import score
from nnode.errors import NNodeError
from studies.runner import Task

#: Base models by their name in the truth: the term that is calibrated.
TERMS = {"lin": "lin", "log": "log", "sf": "social_force"}

#: Verdict where a diagnosis ended with an error of its own.
ERROR = "error"

#: Sources on which a result depends: it does not hold when they have changed.
_SOURCES = (
    "nnode/app/discover.py",
    *(f"benchmarks/discovery/{n}.py" for n in ("fresh", "peers", "task")),
)
_FOLDERS = (
    "benchmarks/synthetic_cases",
    *(f"nnode/{name}" for name in ("discover", "models", "data", "calibrate", "solvers")),
)

#: What of a peer's score is kept.
_KEPT = ("named", "exact", "class_right", "found", "false_names", "closure", "worse", "right")


def diagnose_case(
    case: dict[str, Any],
    peers: bool = False,
    seeds_of: str | None = None,
    structure: bool = True,
    rules: dict[str, float] | None = None,
    fresh: int = 0,
) -> dict[str, Any]:
    """The score of one diagnosis, and how long it took.

    The truth stays outside the folder that the diagnosis is given.

    Args:
        case: of :class:`benchmarks.synthetic_cases.Case`, as plain JSON.
        peers: scores of the peers as well, by name.
        seeds_of: hash of the commit that the seed comes from; is handed through.
        structure: as in the options of the diagnosis.
        rules: numbers that differ from those of :class:`~nnode.discover.rules.Rules`.
        fresh: so many sequences more are made, and kept back to try what was named on them.
    """
    # imported here: all workers read this file, and tests put another diagnosis in its place
    from benchmarks.discovery.fresh import kept_back, on_fresh
    from benchmarks.discovery.peers import peers_on_table
    from nnode.app import discover
    from nnode.discover.options import DiscoverOptions
    from nnode.discover.rules import Rules
    from nnode.model.effects import CATALOGUE

    what = Case.from_dict(case)
    classes = {effect.name: effect.confusable_group for effect in CATALOGUE.effects.values()}
    with TemporaryDirectory(prefix="nnode-case-") as made, TemporaryDirectory() as given:
        start = time.monotonic()
        truth = generate(replace(what, n_sequences=what.n_sequences + fresh), Path(made))
        whole, truth = truth, {**truth, "case": case}
        generated = time.monotonic() - start
        for name in (TABLE, WALLS):
            if (Path(made) / name).exists():
                (Path(made) / name).rename(Path(given) / name)
        model = truth["model"]
        told: dict[str, Any] = {
            "model": {"name": model["name"], "term": TERMS[model["name"]], **model["options"]},
            "walls": Path(given) / WALLS if what.domain == "crowd" else None,
            "leader": model.get("leader", "measured"),
            "seed": what.seed,
        }
        table = Path(given) / TABLE
        back = kept_back(table, fresh)
        start, failure, later = time.monotonic(), "", {}
        try:
            options = DiscoverOptions(
                page=False,
                replay=False,
                structure=structure,
                compare=[],
                rules=Rules(**(rules or {})),
            )
            found = discover.diagnose_table(table, what.domain, **told, options=options)
            report = found.plain()
        except NNodeError as error:
            report, failure = {"verdict": ERROR, "effects": []}, f"{type(error).__name__}: {error}"
        seconds = time.monotonic() - start
        if fresh and not failure:
            later = on_fresh(back, found, whole, what.domain, told["walls"])
        others: dict[str, Any] = {}
        if peers and not failure:
            for name, other in peers_on_table(table, what.domain, **told).items():
                scored = score(truth, other, classes)
                others[name] = {key: scored[key] for key in _KEPT}
    return {
        **score(truth, report, classes),
        **later,
        "seeds_of": seeds_of,
        "seconds": seconds,
        "seconds_to_generate": generated,
        "laps": report.get("seconds", {}),
        "peers": others,
        "failure": failure,
    }


def task_of(
    case: Case, peers: bool, seeds_of: str | None, structure: bool = True, fresh: int = 0
) -> Task:
    """A case as a task that is kept; larger ones start first."""
    size = case.n_sequences * (1.0 if case.domain == "traffic" else 2.0)
    arguments = {
        "case": case.to_dict(),
        "peers": peers,
        "seeds_of": seeds_of,
        "structure": structure,
        "fresh": fresh,
    }
    return Task(case.key, diagnose_case, arguments, cost=size)


def sources() -> str:
    """A digest of all code that takes part: kept results of other code do not hold."""
    # each in its own place: nnode may be installed, the benchmarks never are
    root = {"nnode": Path(nnode.__file__).parents[1], "benchmarks": Path(__file__).parents[2]}
    files = list(_SOURCES)
    for folder in _FOLDERS:
        top = root[folder.partition("/")[0]]
        files += [path.relative_to(top).as_posix() for path in (top / folder).rglob("*.py")]
    digest = hashlib.sha256()
    for file in sorted(files):
        place = root[file.partition("/")[0]] / file
        digest.update(file.encode() + b"\0" + place.read_bytes())
    return digest.hexdigest()[:16]
