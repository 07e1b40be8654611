"""A run's model drives vehicles in SUMO: ``nnode drive``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from nnode.app.export import checkpoint_of
from nnode.calibrate.checkpoint import Checkpoint, load_checkpoint
from nnode.data.store import MANIFEST, Store
from nnode.errors import ConfigError
from nnode.exchange.drive import Drive, drive
from nnode.exchange.drivers import drivable
from nnode.exchange.running_sumo import Steps
from nnode.files import write_json
from nnode.model import System
from nnode.simulation.base import substeps

#: What ``steps=`` asks for.
STEPS = ("match", "run", "scenario")
#: Of methods, those that SUMO has for speeds and for accelerations.
_PLACED = {1: ("euler",), 2: ("semi_implicit", "ballistic")}


def drive_run(
    run: str | Path,
    *,
    sumo: str | Path,
    vehicles: str | Sequence[str],
    folder: str | Path | None = None,
    program: str = "libsumo",
    steps: str = "match",
    end: float | None = None,
    far: float | None = None,
    lengths: bool | None = None,
    lane_changes: bool = False,
    seed: int = 0,
) -> Drive:
    """Let a run's calibrated law, with its effects, drive vehicles in SUMO.

    Every step SUMO says who is ahead and how far, the law says a speed, and SUMO places the
    vehicle with it; its own rules for speeds and, if so, lanes are off. See ``docs/exchange.md``.

    Args:
        run: folder of a training or of a diagnosis, or a checkpoint; its model is of vehicles.
        sumo: SUMO's configuration, ``.sumocfg``.
        vehicles: type, or types, of the vehicles to drive.
        folder: receives ``fcd.xml.gz`` (``data=sumo`` reads it) and ``drive.json``; by default a
            new temporary one.
        program: ``libsumo``, in this process, or ``traci``.
        steps: ``match`` refuses a scenario whose steps are not the run's; ``run`` lets SUMO make
            the run's; ``scenario`` takes those of the scenario. The steps of a law that is stepped
            by Runge and Kutta's method by default are ballistic ones of the same length here.
        end: s of SUMO's clock; None: the scenario's, or when all have arrived.
        far: m at which a vehicle ahead counts as none; None: as far as SUMO looks.
        lengths: whether the law's gaps are bumper to bumper; None: as the run's data had lengths.
        lane_changes: whether SUMO may change lanes of driven vehicles.
        seed: of what drivers who differ are drawn with.

    Raises:
        CheckpointError: no such run.
        ConfigError: people, a model that needs what SUMO cannot say, no such scenario or type of
            vehicles, other steps.
        SimulationError: the law says no finite number.
    """
    checkpoint = load_checkpoint(checkpoint_of(str(run)))
    model = checkpoint.build()
    order = drivable(model).order
    place = Path(mkdtemp(prefix="nnode-drive-")) if folder is None else Path(folder)
    own = steps_of(checkpoint, model)
    if steps not in STEPS:
        raise ConfigError(f"steps={steps} is unknown, expected {', '.join(STEPS)}")
    if steps == "run" and own.method not in _PLACED[order]:
        raise ConfigError(
            f"steps=run: the run was calibrated with {own}, SUMO can make "
            f"{' or '.join(_PLACED[order])} steps; take steps=scenario"
        )
    found = drive(
        model,
        Path(sumo).expanduser(),
        [vehicles] if isinstance(vehicles, str) else list(vehicles),
        place,
        program=program,
        expected=own if steps == "match" else None,
        told=own if steps == "run" else None,
        end=end,
        far=far,
        lengths=_has_lengths(checkpoint, str(run), model) if lengths is None else lengths,
        lane_changes=lane_changes,
        seed=seed,
    )
    account = {
        **asdict(found),
        "trajectories": str(found.trajectories),
        "run": str(run),
        "sumo": str(sumo),
        "vehicles": vehicles,
        "program": program,
    }
    write_json(place / "drive.json", account)
    return found


def drive_scenario(config: DictConfig, folder: Path) -> None:
    """What the command does: :func:`drive_run`, and a few lines on what came of it."""
    plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    assert isinstance(plain, dict)
    asked: dict[str, Any] = {str(key): value for key, value in plain.items()}
    found = drive_run(asked.pop("run"), folder=folder, **asked)
    speed = "nobody drove" if found.mean_speed is None else f"mean {found.mean_speed:.2f} m/s"
    print(
        f"driven: {found.driven} vehicles, {speed}; {found.seconds:g} s in {found.steps} "
        f"{found.method} steps of {found.step:g} s"
    )
    print(
        f"collisions: {found.collisions}, {found.driven_collisions} of them with driven vehicles; "
        f"teleports: {found.teleports}"
    )
    if found.stranded:
        hint = "" if config.lane_changes else "; lane_changes=true lets SUMO choose their lanes"
        print(f"stopped where a lane did not lead on: {found.stranded} driven vehicles{hint}")
    print(f"took {found.wall:.2f} s, {found.in_sumo:.2f} s of them in SUMO's steps")
    print(f"trajectories: {found.trajectories}")
    print(f"account: {folder / 'drive.json'}")


def steps_of(checkpoint: Checkpoint, model: System) -> Steps:
    """The steps that a run was calibrated with; ballistic ones for a law whose own steps have
    stages, which SUMO does not have."""
    solver, sampling = checkpoint.config["solver"], float(checkpoint.manifest["dt"])
    seconds = sampling / substeps(sampling, solver.get("dt"), model)
    own = "ballistic" if model.step == "rk4" else model.step
    return Steps(seconds, str(solver.get("method") or own))


def _has_lengths(checkpoint: Checkpoint, run: str, model: System) -> bool:
    """Whether a run's data had vehicles' lengths.

    Raises:
        ConfigError: the law asks for them, and the data are not there.
    """
    if "length_1" not in drivable(model).symbols:
        return True
    prepared = checkpoint.config["data"].get("prepared")
    beside = checkpoint_of(run).parent.parent / "data"
    for folder in filter(None, (prepared, beside)):
        if (Path(folder) / MANIFEST).is_file():
            length = Store(Path(folder))[0].length
            return length is not None and bool(np.isfinite(length).any())
    raise ConfigError(
        f"the law asks for the length of the vehicle ahead, and the run's data, {beside}, are not "
        "there to tell whether they had lengths; say lengths=true, gaps are bumper to bumper, or "
        "lengths=false, the law's gap at rest contains a length"
    )
