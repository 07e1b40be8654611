"""Section 5 of the paper: five models on ten recordings, and what the paper leaves open."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from nnode.data.options import EsimasOptions, Faults
from nnode.data.prepare import prepare
from nnode.data.store import Store
from nnode.errors import ConfigError
from nnode.pages.page import Block
from studies.options import TrafficStudyOptions
from studies.runner import Task, hash_of, run_tasks
from studies.traffic import printed, tasks
from studies.traffic.page import blocks
from studies.traffic.results import LAWS, NETWORKS, Study

TITLE = "Traffic: five models on ten recordings"
SUBTITLE = (
    "Section 5 of Göttlich & Totzeck, *Optimal control for interacting particle systems driven "
    "by neural networks*, on the same recordings, printed numbers beside ours."
)

MODELS = (*LAWS, *NETWORKS)
#: Relative time of a gradient.
_TIMES = {"lin": 1.0, "log": 1.2, "n2": 1.5, "n4": 2.0, "n10": 3.5}
#: A recording is searched with up to so many times the starts of the largest one.
_MOST = 12
#: Keys of searches that were made again, wider, begin so in place of ``fit-``.
WIDER = "wider-"
#: Sampling interval of the recordings, s.
SAMPLING = 0.2
#: Other steps at which solutions are evaluated, s.
STEPS = [0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.001]


def run(options: TrafficStudyOptions, folder: Path) -> list[Block]:
    """Compute what is missing and make the page.

    Raises:
        ConfigError: an option out of its range.
        DataError: recordings that cannot be read.
        StudyError: tasks failed.
    """
    _check(options)
    if options.quick:
        options = replace(
            options,
            restarts=4,
            iterations=30,
            folds=2,
            bootstrap=10,
            descent_steps=30,
            particles=10,
            consensus_steps=10,
        )
    stores = {policy: _prepared(options, policy, folder) for policy in ("keep", "drop")}
    assert options.workers is not None
    how: dict[str, Any] = {"workers": options.workers, "fingerprint": hash_of(stores)}
    first = list(_tasks(options, stores))
    found = run_tasks(first, folder, title="traffic study", **how)
    again = [] if options.quick else _wider(first, found)
    if again:
        wider = run_tasks(again, folder, title="wider search", **how)
        found |= {_replaces(key, found, one): one for key, one in wider.items()}
    return blocks(Study(options, stores, found))


def _check(options: TrafficStudyOptions) -> None:
    least = {
        "restarts": 1,
        "iterations": 3,
        "bootstrap": 2,
        "folds": 2,
        "descent_steps": 1,
        "batch_size": 0,
        "particles": 2,
        "consensus_steps": 1,
    }
    for name, low in least.items():
        if getattr(options, name) < low:
            raise ConfigError(f"study.{name}={getattr(options, name)} must be at least {low}")
    for name in ("box", "descent_lr"):
        if not getattr(options, name) > 0:
            raise ConfigError(f"study.{name}={getattr(options, name)} must be positive")
    for name in ("dt", "descent_dt"):
        step = getattr(options, name)
        if not (0 < step <= SAMPLING and abs(SAMPLING / step - round(SAMPLING / step)) < 1e-6):
            raise ConfigError(
                f"study.{name}={step} s must divide the sampling interval of {SAMPLING} s"
            )


def _wider(tasks_: list[Task], found: dict[str, dict[str, Any]]) -> list[Task]:
    """Twice the search, from other starts, where the printed cost of a network is lower."""
    again = []
    for task in tasks_:
        one = found[task.key]
        if not task.key.startswith("fit-keep-") or one["model"] in LAWS or one["box"] is not None:
            continue
        theirs = printed.COSTS[one["model"]][printed.RECORDINGS.index(one["recording"])]
        if theirs < one["cost"]:
            wide = {key: 2 * task.arguments[key] for key in ("restarts", "iterations")}
            other = {**task.arguments, **wide, "seed": task.arguments["seed"] + 1}
            again.append(Task(task.key.replace("fit-", WIDER, 1), tasks.fit, other, 4 * task.cost))
    return again


def _replaces(key: str, found: dict[str, dict[str, Any]], one: dict[str, Any]) -> str:
    """The key under which a wider search counts: that of the first one where it is better."""
    first = key.replace(WIDER, "fit-", 1)
    if one["cost"] < found[first]["cost"]:
        one["before"] = found[first]["cost"]
        return first
    return key


def _prepared(options: TrafficStudyOptions, policy: str, folder: Path) -> Store:
    # one folder for both policies, so that nothing is fetched twice
    download = options.download or str(folder / "data" / "raw")
    chosen = EsimasOptions(
        name="esimas", source=options.source, download=download, faults=Faults(policy)
    )
    return prepare(chosen, folder / "data" / policy)


def _sizes(store: Store) -> dict[str, int]:
    """Measured positions of followers by recording: what a gradient's time goes with."""
    sizes: dict[str, int] = {}
    for entry in store.index:
        size = (entry["n_agents"] - 1) * entry["n_samples"]
        sizes[entry["recording"]] = sizes.get(entry["recording"], 0) + size
    return sizes


def _tasks(options: TrafficStudyOptions, stores: dict[str, Store]) -> Iterator[Task]:
    for policy, store in stores.items():
        sizes = _sizes(store)
        largest = max(sizes.values())
        for name, size in sizes.items():
            # as much time for a small recording as for the largest: it has as many minima
            share = min(_MOST, largest / size)
            for model in MODELS:
                yield from _of_model(options, policy, str(store.folder), name, model, size, share)


def _of_model(
    options: TrafficStudyOptions,
    policy: str,
    folder: str,
    name: str,
    model: str,
    size: int,
    share: float,
) -> Iterator[Task]:
    where = {"folder": folder, "recording_name": name, "model": model, "dt": options.dt}
    where["seed"] = options.seed
    time = _TIMES[model] * size
    boxes = (None, options.box) if model in NETWORKS else (None,)
    for box in boxes:
        suffix = "" if box is None else "-box"
        # laws have two parameters: few starts find what there is
        starts = options.restarts / 4
        if box is None and model in NETWORKS:
            starts = options.restarts * _TIMES["n4"] / _TIMES[model]
        if policy == "drop":
            starts /= 2
        search: dict[str, Any] = {
            **where,
            "box": box,
            "restarts": max(2, round(starts * share)),
            "iterations": options.iterations,
        }
        if box is None or policy == "keep":
            draws = options.bootstrap if box is None else 0
            yield Task(
                f"fit-{policy}-{name}-{model}{suffix}",
                tasks.fit,
                {**search, "bootstrap": draws, "steps": STEPS},
                cost=3 * time,
            )
        yield Task(
            f"heldout-{policy}-{name}-{model}{suffix}",
            tasks.cross_validate,
            {
                **search,
                "restarts": max(2, options.restarts // 4),
                "iterations": max(20, options.iterations * 2 // 3),
                "folds": options.folds,
            },
            cost=3 * time,
        )
    if policy == "drop":
        return
    yield Task(
        f"descent-{name}-{model}",
        tasks.descend,
        {
            **where,
            "restarts": 2,
            "steps": options.descent_steps,
            "updates_dt": options.descent_dt,
            "lr": options.descent_lr,
            "batch_size": options.batch_size,
        },
        cost=2 * time,
    )
    yield Task(
        f"consensus-{name}-{model}",
        tasks.agree,
        {**where, "particles": options.particles, "steps": options.consensus_steps},
        cost=time,
    )
    if model in LAWS:
        yield Task(f"scan-{name}-{model}", tasks.scan, _scan(where, options.quick), cost=time)


def _scan(where: dict[str, Any], quick: bool) -> dict[str, Any]:
    return {k: v for k, v in where.items() if k != "seed"} | {"points": 21 if quick else 81}
