"""Stored results, computed again: ``python -m benchmarks.regression [WORD ...] [--store]``.

Only what has one of the words in its name is computed. Names begin with ``diagnosis`` (30 small
data sets with fixed seeds: cars by ``lin`` and ``idm``, people by ``sf``), ``calibration`` (a few
epochs of every model, or until Gauss and Newton's method converges), ``checkpoint`` (files of an
earlier version are loaded and simulated), ``study`` (the quick study of traffic, where
``NNODE_DATA`` names the recordings) and ``speed`` (gradients of the compiled code against
``odeint_adjoint``, in turns). Words must be equal, numbers to 1e-6 of their size, ratios of times
within a factor of two, because they differ between machines. Differences are printed, and the exit
status is 1 if there are any. Three calibrations depend on the rounding of the processor, on the
same code: the cost of ``ovm`` by L-BFGS (1.4e-3), that of ``newell`` by ADADELTA (2e-5), and the
parameters ``a`` and ``l`` of ``cfsm``, on which its cost hardly depends (1e-2). ``--store``
replaces the stored results, checkpoints included.

The data are integrated here, by code that is not the package's; everything else is its public
interface.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import nnode

STORED = Path(__file__).with_suffix(".json")
CHECKPOINTS = Path(__file__).with_name("regression_checkpoints.zip")
#: Names the folder that checkpoints are written to, for the processes.
FOLDER = "NNODE_REGRESSION_STORE"
TOLERANCE = 1e-6
#: Ratios of times may lie this factor apart.
LOOSE = 2.0

LANE_EFFECTS = (
    "none",
    "zone",
    "period",
    "relative_speed",
    "anticipation",
    "drivers",
    "delay",
    "trucks",
)
CROWD_EFFECTS = (
    "none",
    "drift",
    "speed",
    "alignment",
    "obstacle",
    "side",
    "repulsion",
    "cohesion",
)
LAWS = (
    "lin",
    "log",
    "n2",
    "n4",
    "n10",
    "idm",
    "ovm",
    "fvdm",
    "gipps",
    "krauss",
    "helly",
    "newell",
    "a2",
    "a4",
    "a10",
)
CROWD_LAWS = ("sf", "nn", "esf", "cfsm", "gcfm", "ttc")
EXTENDED = (
    ("lin", "relative_speed", "speed_zone"),
    ("lin", "reaction_delay"),
    ("idm", "memory"),
    ("sf", "alignment"),
    ("sf", "anticipation", "drift"),
    ("newell", "speed_zone"),
)
STUDIES = ("traffic",)
WALLS = [(-8.0, 0.0, 8.0, 0.0), (8.0, 4.5, -8.0, 4.5)]


def lanes(law: str, effect: str, seed: int, number: int = 24, seconds: float = 25.0) -> Any:
    """Platoons of five behind a leader of varying speed, whose followers obey ``lin`` or ``idm``
    with an effect, as a tidy table; noise of 0.05 m."""
    draw, h, every, cars, warm = np.random.default_rng(seed), 0.02, 10, 5, 750
    height, period, phase = (
        draw.uniform(ends[0], ends[1], (4, number))
        for ends in ((0.8, 2.0), (8.0, 30.0), (0.0, 6.0))
    )
    own = 28 * (1 + 0.08 * (effect == "drivers") * draw.normal(size=(number, cars - 1)))
    truck = draw.random((number, cars)) < 0.3
    own *= np.where((effect == "trucks") & truck[:, 1:], 0.85, 1.0)
    x = draw.uniform(-150, 150, (number, 1)) - 18.0 * np.arange(cars)
    v, rows = np.full(x.shape, 17.0), []
    late: list[np.ndarray] = []
    for k in range(warm + round(seconds / h) + 1):
        if k >= warm and k % every == 0:
            rows.append(x)
        late = [*late[-25:], x]
        seen = late[0] if effect == "delay" else x
        gap = np.maximum(seen[:, :-1] - seen[:, 1:], 3.0)
        factor = np.ones_like(gap)
        if effect == "zone":
            factor[(x[:, 1:] > 350) & (x[:, 1:] < 500)] = 0.65
        if effect == "period":
            factor[:] = 0.75 if 6 < (k - warm) * h < 14 else 1.0
        ahead = v[:, :-1] - v[:, 1:]
        leader = 17 + (height * np.sin(2 * np.pi * k * h / period + phase)).sum(0)
        if law == "lin":
            speed = own * factor * (1 - 6 / gap)
            if effect == "relative_speed":
                speed += 0.35 * (v[:, :-1] - speed)
            if effect == "anticipation":
                speed[:, 1:] += 2.0 * np.log(gap[:, :-1] / gap[:, 1:])
            v = np.column_stack([leader, speed])
        else:
            wish = 2 + np.maximum(1.2 * v[:, 1:] - v[:, 1:] * ahead / (2 * np.sqrt(1.3 * 1.7)), 0)
            rate = 1.3 * (1 - (v[:, 1:] / (own * factor)) ** 4 - (wish / (gap - 4.5)) ** 2)
            if effect == "relative_speed":
                rate += 0.3 * ahead
            if effect == "anticipation":
                rate[:, 1:] += 0.8 * np.log(gap[:, :-1] / gap[:, 1:])
            v = np.column_stack([leader, np.maximum(v[:, 1:] + h * rate, 0)])
        x = x + h * v
    place = np.stack(rows) + 0.05 * draw.normal(size=(len(rows), number, cars))
    columns = {"x": place}
    if effect == "trucks":
        columns["class"] = np.broadcast_to(np.where(truck, "truck", "car"), place.shape)
    if law == "idm":
        columns["length"] = np.full(place.shape, 4.5)
    return _table(h * every, columns)


def people(effect: str, seed: int, number: int = 14, samples: int = 46, several: int = 8) -> Any:
    """People who walk both ways through a corridor by a social force and an effect, as a tidy
    table; noise of 0.005 m."""
    draw, h, every = np.random.default_rng(seed), 0.02, 5
    way = np.where(np.arange(several) % 2, 1.0, -1.0)
    y = draw.permuted(np.tile(np.linspace(0.9, 3.6, several), (number, 1)), axis=1)
    y = y + draw.uniform(-0.05, 0.05, y.shape)
    x = np.stack([-way * draw.uniform(1.5, 4.0, y.shape), y], -1)
    goal = np.stack([np.broadcast_to(25.0 * way, y.shape), y], -1)
    v = np.stack([way * draw.uniform(1.0, 1.6, y.shape), 0 * y], -1)
    away, rows, off = np.stack([0 * y, 0 * y], -1), [], 1 - np.eye(several)
    for k in range((samples - 1) * every + 1):
        if k % every == 0:
            rows.append(x)
        to, speed = goal - x, np.linalg.norm(v, axis=-1, keepdims=True)
        ahead = to / np.linalg.norm(to, axis=-1, keepdims=True)
        rate = (speed * ahead - v) / 0.5
        offset = x[:, :, None] - x[:, None]
        apart = np.sqrt((offset**2).sum(-1) + 1e-12)
        push = (9.0 if effect == "repulsion" else 3.0) * np.exp((0.5 - apart) / 0.3) * off / apart
        rate += (push[..., None] * offset).sum(2) / several
        for wall, sign in ((0.0, 1.0), (4.5, -1.0)):
            rate[..., 1] += sign * 3.0 * np.exp((0.25 - np.abs(x[..., 1] - wall)) / 0.3)
        if effect == "drift":
            rate[..., 1] += 0.35
        if effect == "speed":
            rate += 0.8 * (1.4 - speed) * ahead
        if effect == "side":
            rate += 0.3 * np.stack([ahead[..., 1], -ahead[..., 0]], -1)
        if effect in ("alignment", "cohesion"):
            near = np.exp(-apart / 1.5) * off * (way[:, None] == way)
            near = (near / near.sum(2, keepdims=True))[..., None]
            rate += 0.8 * (near * (v[:, None] - v[:, :, None])).sum(2) * (effect == "alignment")
            rate -= 0.4 * (near * offset).sum(2) * (effect == "cohesion")
        if effect == "obstacle":
            away = x - np.array([0.5, 2.2])
            far = np.linalg.norm(away, axis=-1, keepdims=True)
            rate += 3.0 * np.exp((0.5 - far) / 0.3) * away / far
        x, v = x + h * v, v + h * rate
    place = np.stack(rows) + 0.005 * draw.normal(size=(samples, *x.shape[:2], 2))
    ends = np.broadcast_to(goal, place.shape)
    columns = {"x": place[..., 0], "y": place[..., 1]}
    return _table(h * every, columns | {"dest_x": ends[..., 0], "dest_y": ends[..., 1]})


def _table(dt: float, columns: dict[str, np.ndarray]) -> pd.DataFrame:
    samples, number, agents = columns["x"].shape
    run = np.arange(number)[:, None]
    clock = dt * np.arange(samples)[:, None, None] + 100.0 * run
    head = {"sequence": run, "time": clock.round(6), "agent": agents * run + np.arange(agents)}
    shape = columns["x"].shape
    flat = {k: np.broadcast_to(v, shape).ravel() for k, v in (head | columns).items()}
    return pd.DataFrame(flat)


def diagnosis(law: str, effect: str, seed: int) -> dict[str, Any]:
    """Verdict, and names with coefficients of what was added or is only suspected; numbers of
    suspicions, of errors and of the calibrated law."""
    from nnode.discover.options import DiscoverOptions

    crowd = law == "sf"
    table = people(effect, seed) if crowd else lanes(law, effect, seed)
    options = DiscoverOptions(
        page=False,
        replay=False,
        structure=effect in ("none", "delay"),
        compare=["lin", "log"] if law == "lin" and effect == "none" else [],
    )
    with tempfile.TemporaryDirectory() as folder:
        found = nnode.diagnose(
            table,
            "crowd" if crowd else "traffic",
            model=law,
            seed=seed,
            options=options,
            walls=_walls(folder) if crowd else None,
        )
    plain = found.plain()
    effects = {
        f"{part} {one['name']}": {k: c["value"] for k, c in one["coefficients"].items()}
        for part in ("effects", "leads")
        for one in plain[part]
    }
    gap = {k: v for k, v in plain["gap"].items() if isinstance(v, float)}
    return {"verdict": plain["verdict"], **effects, "gap": gap, "law": _parameters(found.model)}


def _parameters(model: Any) -> dict[str, float]:
    """Norms: a network has many numbers."""
    return {name: float(p.detach().norm()) for name, p in model.named_parameters()}


def _walls(folder: str) -> Path:
    path = Path(folder) / "walls.csv"
    pd.DataFrame(WALLS, columns=["x1", "y1", "x2", "y2"]).to_csv(path, index=False)
    return path


def _sequences(law: str) -> Any:
    """Little data for a calibration."""
    if law in CROWD_LAWS:
        with tempfile.TemporaryDirectory() as folder:
            return nnode.sequences(people("speed", 5, 4, 16, 5), walls=str(_walls(folder)))
    return nnode.sequences(lanes("idm", "none", 5, 4, 8.0))


def calibration(law: str, optimizer: str, solver: str, *effects: str) -> dict[str, Any]:
    """Costs before and after, and what was calibrated. Gauss and Newton's method goes on until it
    converges: its way there is no result."""
    one = (
        nnode.Calibrator(
            law,
            effects=effects,
            optimizer=optimizer,
            solver=solver,
            dt=None if solver == "fused" else 0.05,
            leader=None if law in CROWD_LAWS else "measured",
            epochs=100 if optimizer == "gauss_newton" else 2,
        )
        .fit(_sequences(law))
        .result_
    )
    found = {"start": one.cost_start, "cost": one.cost, "parameters": _parameters(one.model)}
    folder = os.environ.get(FOLDER)
    if folder and optimizer == "adadelta":
        one.save(Path(folder) / ("-".join((law, optimizer, solver, *effects)) + ".pt"))
    return found


def checkpoint(name: str) -> dict[str, Any]:
    """The cost of a loaded model, and what its formula or network gives."""
    with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(CHECKPOINTS) as archive:
        model = nnode.load(archive.extract(name, folder))
    law = name.split("-")[0]
    again = nnode.Calibrator(model, optimizer="adadelta", epochs=1).fit(_sequences(law)).result_
    return {"cost": again.cost_start, "parameters": _parameters(model)}


def study(name: str) -> dict[str, Any]:
    """Sums over the columns of a quick study's tables, without those of networks' weights, which
    data do not determine, and of held-out means, which contain runaways."""
    with tempfile.TemporaryDirectory() as folder:
        words = [f"study={name}", "study.quick=true", "study.workers=1", f"hydra.run.dir={folder}"]
        subprocess.run(
            [sys.executable, "-m", "nnode", "study", *words], check=True, stdout=subprocess.DEVNULL
        )
        tables = sorted(Path(folder).rglob("*.csv"))
        return {
            path.name: pd.read_csv(path).select_dtypes("number").abs().sum().to_dict()
            for path in tables
            if path.stem not in ("parameters", "laws", "heldout")
        }


def speed(model: str) -> dict[str, Any]:
    """Time of a gradient by ``odeint_adjoint`` in those of the compiled code, median of turns."""
    import torch

    from benchmarks.speed.engines import ENGINES
    from benchmarks.speed.problems import Shape, pose

    problem = pose(Shape("traffic", (model,), 100, 10, 5, 100, 0.002), model, torch.float32)
    calls = [ENGINES[name].prepare(problem) for name in ("odeint_adjoint", "fused_1")]
    for call in calls:
        call()
    times = []
    for _ in range(3):
        clock = [time.process_time()]
        for call in calls:
            call()
            clock.append(time.process_time())
        times.append((clock[1] - clock[0]) / (clock[2] - clock[1]))
    return {"ratio": sorted(times)[1]}


def tasks() -> list[tuple[Any, ...]]:
    """Every part's function with its arguments, the longest first."""
    hidden = [("sf", effect) for effect in (*CROWD_EFFECTS, "none", "drift")]
    hidden += [
        (law, effect) for law in ("idm", "lin") for effect in (*LANE_EFFECTS, "none", "zone")
    ]
    found: list[tuple[Any, ...]] = []
    if os.environ.get("NNODE_DATA"):
        found = [("study", name) for name in STUDIES]
    found += [("diagnosis", *what, seed) for seed, what in enumerate(hidden)]
    for law in (*LAWS, *CROWD_LAWS):
        found += [("calibration", law, "lbfgs", "fused")]
        if law not in ("lin", "log", "n2", "n4", "n10", "nn", "newell", "a2", "a4", "a10"):
            found += [("calibration", law, "gauss_newton", "fused")]
        found += [("calibration", law, "adadelta", "torchdiffeq")]
    found += [("calibration", law, "adadelta", "fused", *effects) for law, *effects in EXTENDED]
    if CHECKPOINTS.exists():
        found += [("checkpoint", name) for name in zipfile.ZipFile(CHECKPOINTS).namelist()]
    return found + [("speed", model) for model in ("n4", "idm")]


def computed(task: tuple[Any, ...]) -> Any:
    """A result, or the error in words."""
    import torch

    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    part, *arguments = task
    start = time.monotonic()
    try:
        found = globals()[part](*arguments)
    except Exception as error:
        found = {"error": f"{type(error).__name__}: {error}"}
    seconds = time.monotonic() - start
    return part, " ".join(map(str, arguments)), found, seconds


def differences(old: Any, new: Any, where: str) -> list[str]:
    """What is not equal, a line each."""
    if isinstance(old, dict) and isinstance(new, dict):
        keys = sorted(old.keys() | new.keys())
        return [
            line
            for key in keys
            for line in differences(old.get(key), new.get(key), f"{where} / {key}")
        ]
    if isinstance(old, float) and isinstance(new, float):
        if where.startswith("speed"):
            good = max(old, new) < LOOSE * min(old, new)
        else:
            good = math.isclose(old, new, rel_tol=TOLERANCE, abs_tol=1e-12) or old != old != new
        change = abs(new - old) / max(abs(old), 1e-300)
        return [] if good else [f"{where}: {old!r} -> {new!r} ({change:.1e})"]
    return [] if old == new else [f"{where}: {old!r} -> {new!r}"]


def _keep(folder: Path) -> None:
    """Put new checkpoints into the archive, in place of those of the same names."""
    content = {file.name: file.read_bytes() for file in folder.iterdir()}
    if CHECKPOINTS.exists():
        with zipfile.ZipFile(CHECKPOINTS) as archive:
            content = {name: archive.read(name) for name in archive.namelist()} | content
    with zipfile.ZipFile(CHECKPOINTS, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in sorted(content.items()):
            archive.writestr(name, data)


def main() -> int:
    """Compute, compare or store."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("words", nargs="*", help="only what has one of these in its name")
    parser.add_argument("--store", action="store_true", help="write what is computed")
    chosen = parser.parse_args()
    stored = json.loads(STORED.read_text()) if STORED.exists() else {}
    lines: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        if chosen.store:
            os.environ[FOLDER] = folder  # for the processes
        for loads in (False, True):
            todo = [task for task in tasks() if (task[0] == "checkpoint") == loads]
            names = [" ".join(map(str, task)) for task in todo]
            every = not chosen.words
            todo = [
                task
                for task, name in zip(todo, names, strict=True)
                if every or any(word in name for word in chosen.words)
            ]
            if not chosen.store:  # what there is to compare with
                todo = [t for t in todo if " ".join(map(str, t[1:])) in stored.get(t[0], {})]
            with multiprocessing.get_context("spawn").Pool(2) as pool:
                for part, name, result, seconds in pool.imap_unordered(computed, todo):
                    old = stored.get(part, {}).get(name)
                    new = differences(old, result, f"{part} / {name}")
                    lines += new
                    print(f"{part} {name}: {len(new)} differ, {seconds:.1f} s", flush=True)
                    if chosen.store:
                        stored.setdefault(part, {})[name] = result
                        STORED.write_text(json.dumps(stored, indent=1, sort_keys=True) + "\n")
            if chosen.store and not loads:
                _keep(Path(folder))
    print("\n".join(lines) or "nothing differs")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
