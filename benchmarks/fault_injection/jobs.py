"""The jobs that are killed: each script on data so small that a run takes a second or a few."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.fault_injection.child import Child, script
from nnode.app.python.report import Report
from nnode.calibrate.checkpoint import load_checkpoint
from nnode.data.prepare import prepare
from nnode.data.readers.esimas import EsimasOptions
from nnode.data.store import MANIFEST, Store
from nnode.data.synthetic import traffic_recording
from nnode.pages.page import Block, TableBlock
from nnode.program import configuration
from studies.runner import Task, run_tasks
from studies.traffic.tasks import fit, scan

#: Names of entries that say how long something took, or when, and columns of tables that do.
_CLOCKS = ("seconds", "time taken", "laps")
_TIMED = ("s", "duration", "minutes")


@dataclass(frozen=True)
class Job:
    """A script that is killed and started again.

    Attributes:
        name: of the script.
        first: the overrides of a run from the start.
        again: those after a kill, given the run's folder; by default the same.
        results: of its end, without anything that depends on the clock.
        kept: what a kill must not take away: a number that never falls, or a set that never
            shrinks.
        share: of the kills; jobs that take longer get fewer.
        before: done in the process before the script.
    """

    name: str
    first: list[str]
    results: Callable[[Path], Any]
    kept: Callable[[Path], Any]
    share: int = 1
    again: Callable[[Path], list[str] | None] = lambda folder: None
    before: Callable[[], None] = field(default=lambda: None)

    def start(
        self,
        folder: Path,
        *,
        before: Callable[[], object] = lambda: None,
        resumed: Collection[str] = (),
        output: Path | None = None,
    ) -> Child:
        """Start it in a process of its own, or go on with what is in a run's folder.

        Args:
            before: done in the process as the last thing before the script.
            resumed: further overrides of a run that goes on.
            output: receives what it prints; by default a file beside the folder.
        """
        again = self.again(folder)
        given = self.first if again is None else [*again, *resumed]

        def work() -> None:
            self.before()
            before()
            script(configuration().parent, self.name, [*given, f"hydra.run.dir={folder}"])

        return Child(work, output or self.output(folder))

    @staticmethod
    def output(folder: Path) -> Path:
        """The file that receives what a run prints, beside its folder."""
        return folder.with_name(f"{folder.name}.txt")

    def words(self, folder: Path) -> str:
        """The last words of a run."""
        return self.output(folder).read_text()[-1500:]


def timeless(value: Any) -> Any:
    """Plain results without what depends on the clock, comparable even where they hold NaN."""
    if isinstance(value, dict):
        return {k: timeless(v) for k, v in value.items() if not _of_clock(str(k))}
    if isinstance(value, list):
        return [timeless(item) for item in value]
    return "nan" if isinstance(value, float) and math.isnan(value) else value


def _of_clock(name: str) -> bool:
    return any(word in name.lower() for word in _CLOCKS)


def _model(path: Path) -> dict[str, Any]:
    checkpoint = load_checkpoint(path)
    tensors = {name: value.tolist() for name, value in checkpoint.model.items()}
    return {"model": tensors, "history": timeless(checkpoint.history), "split": checkpoint.split}


def _prepared(folder: Path) -> dict[str, Any]:
    store = Store(folder)
    return {
        "manifest": timeless(store.manifest),
        "sequences": [(s.name, s.time.tobytes(), s.x.tobytes()) for s in store],
        "plots": sorted(p.name for p in (folder / "faults").glob("*")),
    }


def _trained(folder: Path) -> dict[str, Any]:
    content = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    models = {name: _model(folder / "checkpoints" / name) for name in ("last.pt", "best.pt")}
    return {**models, "summary": timeless(content["summary"])}


def _steps(folder: Path) -> float:
    path = folder / "checkpoints" / "last.pt"
    return float(load_checkpoint(path).progress["step"]) if path.exists() else -1.0


def _tasks(folder: Path) -> dict[str, Any]:
    kept = sorted((folder / "tasks").glob("*.json"))
    found = {p.name: timeless(json.loads(p.read_text())["result"]) for p in kept}
    tables = {}
    for path in sorted(folder.glob("*.csv")):
        frame = pd.read_csv(path)
        timed = [name for name in frame.columns if name in _TIMED or _of_clock(name)]
        tables[path.name] = frame.drop(columns=timed).to_csv(index=False)
    return {"results": found, "tables": tables}


def _names(folder: Path) -> set[str]:
    return {path.name for path in (folder / "tasks").glob("*.json")}


def _reported(folder: Path) -> dict[str, Any]:
    return {
        "report": timeless(json.loads((folder / "report.json").read_text(encoding="utf-8"))),
        "checkpoint": _model(folder / "checkpoints" / "best.pt"),
        "yaml": (folder / "model.yaml").read_text(encoding="utf-8"),
    }


class Small:
    """A study of a few calibrations on the demonstration's traffic, as the large ones are made."""

    TITLE, SUBTITLE = "A small study", "Two laws on one recording."

    def __init__(self, raw: Path) -> None:
        self.raw = raw

    def run(self, options: Any, folder: Path) -> list[Block]:
        """Six tasks and one table."""
        data = EsimasOptions(name="demo_traffic", recording="demo", source=str(self.raw))
        prepare(data, folder / "data")
        where = {"folder": str(folder / "data"), "recording_name": "demo"}
        short = {"restarts": 1, "dt": 0.1, "iterations": 4, "bootstrap": 0, "steps": []}
        tasks = [
            Task(
                f"fit-{model}-{seed}",
                fit,
                {**where, "model": model, "box": None, "seed": seed, **short},
            )
            for model in ("lin", "log")
            for seed in (0, 1)
        ]
        tasks += [
            Task(f"scan-{model}", scan, {**where, "model": model, "points": 5, "dt": 0.1})
            for model in ("lin", "log")
        ]
        found = run_tasks(tasks, folder, workers=options.workers, fingerprint="demo")
        frame = pd.DataFrame({"task": list(found), "cost": [one["cost"] for one in found.values()]})
        return [TableBlock("costs", frame.set_index("task"), "Costs.")]


def jobs(raw: Path) -> list[Job]:
    """All jobs; the demonstration's traffic is written to ``raw``."""
    _load_libraries()
    recorded = traffic_recording(raw / "esimas" / "sequence_datademo.mat", seed=0)
    source, table = f"data.source={raw}", raw / "lane.csv"
    _lane(recorded, table)
    return [
        Job(
            "prepare_data",
            ["data=demo_traffic", source],
            _prepared,
            lambda folder: 1.0 if (folder / MANIFEST).exists() and len(Store(folder)) else 0.0,
            share=60,
        ),
        Job(
            "train",
            [
                "experiment=demo_traffic",
                "model=n2",
                "optimizer=adadelta",
                "solver=fused",
                "solver.dt=0.1",
                "trainer.max_epochs=6",
                "trainer.save_every=0.02",
                source,
            ],
            _trained,
            _steps,
            50,
            _resumed(source),
        ),
        Job(
            "study",
            ["study=traffic", "study.workers=1"],
            _tasks,
            _names,
            55,
            before=lambda: _small_study(raw),
        ),
        Job(
            "discover",
            [
                "model=lin",
                "model.leader=measured",
                "data=table",
                f"data.path={table}",
                "data.domain=traffic",
                "discover.effects=[relative_speed]",
                "discover.max_effects=1",
                "discover.step=0.2",
                "discover.replay=false",
                "discover.page=false",
            ],
            _reported,
            lambda folder: 0.0,
            23,
        ),
        Job(
            "benchmark_discovery",
            [
                f"benchmark_discovery.{option}"
                for option in (
                    "domains=[traffic]",
                    "arms=[nothing]",
                    "nothing_seeds=1",
                    "sizes=[4]",
                    "variants=[white,autocorrelated,heterogeneous]",
                    "noises=[0.05]",
                    "baseline_seeds=0",
                    "workers=1",
                )
            ],
            _tasks,
            _names,
            12,
            before=_small_diagnosis,
        ),
    ]


def _resumed(source: str) -> Callable[[Path], list[str] | None]:
    def again(folder: Path) -> list[str] | None:
        last = folder / "checkpoints" / "last.pt"
        return [f"resume={last}", source] if last.exists() else None

    return again


def _small_study(raw: Path) -> None:
    from studies import command as study

    def small(name: str) -> Any:
        return Small(raw)

    vars(study)["import_module"] = small


def _small_diagnosis() -> None:
    """The benchmark's diagnoses look for one effect only: they are not what is tested here."""
    from nnode.app import discover

    whole = discover.diagnose_table

    def small(*given: Any, options: Any, **more: Any) -> Report:
        options.effects, options.max_effects, options.step = ["relative_speed"], 1, 0.2
        return whole(*given, options=options, **more)

    vars(discover)["diagnose_table"] = small


def _lane(recorded: Path, table: Path) -> None:
    """The demonstration's first sequences as a tidy table."""
    from nnode.data.readers.esimas import read_esimas

    found = read_esimas(recorded)[:12]
    rows = [
        {
            "sequence": s.name.replace("/", "-"),
            "time": t,
            "agent": f"{s.name}-{n}",
            "x": s.x[k, n, 0],
        }
        for s in found
        for k, t in enumerate(s.time)
        for n in range(s.n_agents)
    ]
    pd.DataFrame(rows).to_csv(table, index=False)


def _load_libraries() -> None:
    """What the scripts load, so that forked children need not."""
    import tensorboard  # noqa: F401
    import torch.utils.tensorboard

    from benchmarks.discovery import run  # noqa: F401
    from nnode.app import discover, prepare, train  # noqa: F401
    from nnode.discover import diagnose  # noqa: F401
    from nnode.discover.report import page  # noqa: F401
    from nnode.simulation import fused  # noqa: F401
    from studies import command  # noqa: F401

    torch.set_num_threads(1)
