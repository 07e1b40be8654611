"""The jobs that are killed: each script on data so small that a run takes a second or a few."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.fault_injection.child import Child, script
from nnode.app.python.report import Report
from nnode.calibrate.checkpoint import load_checkpoint
from nnode.data.prepare import prepare
from nnode.data.readers.esimas import EsimasOptions, read_esimas
from nnode.data.sequences import Sequences
from nnode.data.store import MANIFEST, Store
from nnode.data.synthetic import traffic_recording
from nnode.pages.page import Block, TableBlock
from nnode.program import configuration
from studies.runner import Task, run_tasks
from studies.traffic.tasks import fit, scan

#: The last checkpoint of a training.
LAST = Path("checkpoints") / "last.pt"
#: Names of entries that say how long something took, or when, and columns of tables that do.
_CLOCKS = ("seconds", "time taken", "laps")
_TIMED = ("s", "duration", "minutes")


@dataclass(frozen=True)
class Job:
    """A script that is killed and started again.

    Attributes:
        name: of the script.
        first: the overrides of a run from the start.
        results: the files of its end that are compared, as patterns.
        share: of the kills; jobs that take longer get fewer.
        resumed: the overrides of a run after a kill that goes on from a checkpoint.
        before: done in the process before the script.
    """

    name: str
    first: list[str]
    results: tuple[str, ...]
    share: int
    resumed: tuple[str, ...] = ()
    before: Callable[[], None] = lambda: None

    def start(
        self,
        folder: Path,
        *,
        before: Callable[[], object] = lambda: None,
        longer: Collection[str] = (),
        output: Path | None = None,
    ) -> Child:
        """Start it in a process of its own, or go on with what is in a run's folder.

        Args:
            before: done in the process as the last thing before the script.
            longer: further overrides of a run that goes on from a checkpoint.
            output: receives what it prints; by default a file beside the folder.
        """
        last, given = folder / LAST, self.first
        if self.resumed and last.exists():
            given = [f"resume={last}", *self.resumed, *longer]

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

    def ended(self, folder: Path) -> dict[str, Any]:
        """The content of the results by file, without anything that depends on the clock."""
        paths = {path for pattern in self.results for path in folder.glob(pattern)}
        return {path.relative_to(folder).as_posix(): _content(path) for path in sorted(paths)}


def kept(folder: Path) -> set[Any]:
    """What a kill must not take away: finished tasks, steps of a training, a prepared store."""
    names: set[Any] = {path.name for path in (folder / "tasks").glob("*.json")}
    if (folder / LAST).exists():
        names |= set(range(int(load_checkpoint(folder / LAST).progress["step"])))
    if (folder / MANIFEST).exists() and len(Store(folder)):
        names.add(MANIFEST)
    return names


def _content(path: Path) -> Any:
    if path.name == MANIFEST:
        store = Store(path.parent)
        sequences = [(s.name, s.time.tobytes(), s.x.tobytes()) for s in store]
        return timeless(store.manifest), sequences
    match path.suffix:
        case ".pt":
            checkpoint = load_checkpoint(path)
            tensors = {name: value.tolist() for name, value in checkpoint.model.items()}
            return tensors, timeless(checkpoint.history), checkpoint.split
        case ".json":
            content = json.loads(path.read_text(encoding="utf-8"))
            # arguments and provenance of a result contain paths and times
            return timeless(content.get("result", content.get("summary", content)))
        case ".csv":
            frame = pd.read_csv(path)
            timed = [name for name in frame.columns if name in _TIMED or _of_clock(name)]
            return frame.drop(columns=timed).to_csv(index=False)
        case ".yaml":
            return path.read_text(encoding="utf-8")
    return None


def timeless(value: Any) -> Any:
    """Plain results without what depends on the clock, comparable even where they hold NaN."""
    if isinstance(value, dict):
        return {k: timeless(v) for k, v in value.items() if not _of_clock(str(k))}
    if isinstance(value, list):
        return [timeless(item) for item in value]
    return "nan" if isinstance(value, float) and math.isnan(value) else value


def _of_clock(name: str) -> bool:
    return any(word in name.lower() for word in _CLOCKS)


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
    first = Sequences(read_esimas(recorded)[:12]).to_dataframe()
    first["agent"] = first["sequence"].astype(str) + "-" + first["agent"].astype(str)
    first.to_csv(table, index=False)
    training = "model=n2 optimizer=adadelta solver=fused solver.dt=0.1 trainer.max_epochs=6"
    diagnosis = (
        "model=lin model.leader=measured data=table data.domain=traffic "
        "discover.effects=[relative_speed] discover.max_effects=1 discover.step=0.2 "
        "discover.replay=false discover.page=false"
    )
    cases = (
        "domains=[traffic] arms=[nothing] nothing_seeds=1 sizes=[4] noises=[0.05] workers=1 "
        "variants=[white,autocorrelated,heterogeneous] baseline_seeds=0"
    )
    tasks = ("tasks/*.json", "*.csv")
    return [
        Job("prepare_data", ["data=demo_traffic", source], (MANIFEST, "faults/*"), 60),
        Job(
            "train",
            ["experiment=demo_traffic", *training.split(), "trainer.save_every=0.02", source],
            ("checkpoints/last.pt", "checkpoints/best.pt", "result.json"),
            50,
            resumed=(source,),
        ),
        Job(
            "study",
            ["study=traffic", "study.workers=1"],
            tasks,
            55,
            before=lambda: _small_study(raw),
        ),
        Job(
            "discover",
            [*diagnosis.split(), f"data.path={table}"],
            ("report.json", "checkpoints/best.pt", "model.yaml"),
            23,
        ),
        Job(
            "benchmark_discovery",
            [f"benchmark_discovery.{option}" for option in cases.split()],
            tasks,
            12,
            before=_small_diagnosis,
        ),
    ]


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


def _load_libraries() -> None:
    """What the scripts load, so that forked children need not."""
    import tensorboard  # noqa: F401
    import torch.utils.tensorboard

    from benchmarks.discovery import run  # noqa: F401
    from nnode.app import discover, prepare, train  # noqa: F401
    from nnode.diagnosis import diagnose  # noqa: F401
    from nnode.diagnosis.report import page  # noqa: F401
    from nnode.simulation import fused  # noqa: F401
    from studies import command  # noqa: F401

    torch.set_num_threads(1)
