"""Control of vehicles in SUMO by a run's model: ``nnode drive``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
from omegaconf import DictConfig

from nnode.app.cli.saved import checkpoint_of, load_run, options_of
from nnode.calibrate.checkpoint import Checkpoint
from nnode.data.store import MANIFEST, Store
from nnode.errors import ConfigError, unknown_value
from nnode.exchange.drive import Drive, drive
from nnode.exchange.drivers import drivable
from nnode.exchange.running_sumo import Steps
from nnode.files import write_json
from nnode.model import System
from nnode.simulation.base import substeps

#: Values of ``steps=``.
STEPS = ("match", "run", "scenario")
#: Order of a law to the methods of stepping that SUMO has for it.
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
    """Control vehicles in SUMO by a run's calibrated law with its effects.

    In every step SUMO gives the gap and the vehicle ahead, the law computes a speed, and SUMO
    moves the vehicle with it. SUMO's rules for speeds, and unless ``lane_changes`` for lanes, are
    disabled. See ``docs/exchange.md``.

    Args:
        run: folder of a training or of a diagnosis, or a checkpoint, with a traffic model.
        sumo: SUMO's configuration, ``.sumocfg``.
        vehicles: type, or types, of the vehicles to control.
        folder: folder for ``fcd.xml.gz`` (``data=sumo`` reads it) and ``drive.json``; by default a
            new temporary one.
        program: ``libsumo``, in this process, or ``traci``.
        steps: ``match`` refuses a scenario with other steps than the run's; ``run`` sets SUMO's
            steps to the run's; ``scenario`` takes the scenario's. For a law whose default method
            is Runge-Kutta, the run's steps are ballistic ones of the same length.
        end: end on SUMO's clock, s; None takes the scenario's, or the arrival of all vehicles.
        far: distance (m) beyond which a vehicle ahead is ignored; None takes SUMO's limit.
        lengths: whether the law's gaps are bumper to bumper; None for gaps as in the run's data.
        lane_changes: whether SUMO may change lanes of controlled vehicles.
        seed: seed of random drivers.

    Raises:
        CheckpointError: the run does not exist.
        ConfigError: a pedestrian model, a model that needs quantities that SUMO does not have, an
            unknown scenario or vehicle type, or other steps.
        SimulationError: the law's speed is not finite.
    """
    checkpoint = load_run(run)
    model = checkpoint.build()
    order = drivable(model).order
    place = Path(mkdtemp(prefix="nnode-drive-")) if folder is None else Path(folder)
    run_steps = steps_of(checkpoint, model)
    if steps not in STEPS:
        raise unknown_value("steps", steps, STEPS)
    if steps == "run" and run_steps.method not in _PLACED[order]:
        raise ConfigError(
            f"steps=run: the run was calibrated with {run_steps}, SUMO can make "
            f"{' or '.join(_PLACED[order])} steps; take steps=scenario"
        )
    result = drive(
        model,
        Path(sumo).expanduser(),
        [vehicles] if isinstance(vehicles, str) else list(vehicles),
        place,
        program=program,
        expected=run_steps if steps == "match" else None,
        forced_steps=run_steps if steps == "run" else None,
        end=end,
        far=far,
        lengths=_has_lengths(checkpoint, str(run), model) if lengths is None else lengths,
        lane_changes=lane_changes,
        seed=seed,
    )
    account = {
        **asdict(result),
        "trajectories": str(result.trajectories),
        "run": str(run),
        "sumo": str(sumo),
        "vehicles": vehicles,
        "program": program,
    }
    write_json(place / "drive.json", account)
    return result


def drive_scenario(config: DictConfig, folder: Path) -> None:
    """The command: run :func:`drive_run`, and print the result."""
    result = drive_run(folder=folder, **vars(options_of(config)))
    speed = "no mean speed" if result.mean_speed is None else f"mean {result.mean_speed:.2f} m/s"
    print(
        f"driven: {result.driven} vehicles, {speed}; {result.seconds:g} s in {result.steps} "
        f"{result.method} steps of {result.step:g} s"
    )
    print(
        f"collisions: {result.collisions}, {result.driven_collisions} of them with driven "
        f"vehicles; teleports: {result.teleports}"
    )
    if result.stranded:
        hint = "" if config.lane_changes else "; lane_changes=true lets SUMO choose their lanes"
        print(f"stopped at the end of their lane: {result.stranded} driven vehicles{hint}")
    print(f"time: {result.wall:.2f} s, of which {result.in_sumo:.2f} s in SUMO's steps")
    print(f"trajectories: {result.trajectories}")
    print(f"account: {folder / 'drive.json'}")


def steps_of(checkpoint: Checkpoint, model: System) -> Steps:
    """The steps of a run's calibration. Ballistic steps replace Runge-Kutta steps, which SUMO does
    not have."""
    solver, sampling = checkpoint.config["solver"], float(checkpoint.manifest["dt"])
    seconds = sampling / substeps(sampling, solver.get("dt"), model)
    default = "ballistic" if model.step == "rk4" else model.step
    return Steps(seconds, str(solver.get("method") or default))


def _has_lengths(checkpoint: Checkpoint, run: str, model: System) -> bool:
    """Whether a run's data had vehicles' lengths.

    Raises:
        ConfigError: the law needs lengths, and the data are missing.
    """
    if "length_1" not in drivable(model).symbols:
        return True
    prepared = checkpoint.config["data"].get("prepared")
    prepared_folder = checkpoint_of(run).parent.parent / "data"
    for folder in filter(None, (prepared, prepared_folder)):
        if (Path(folder) / MANIFEST).is_file():
            length = Store(Path(folder))[0].length
            return length is not None and bool(np.isfinite(length).any())
    raise ConfigError(
        "the law depends on the length of the vehicle ahead, and the run's data, "
        f"{prepared_folder}, are not there to show whether they had lengths; set lengths=true if "
        "gaps are bumper to bumper, or lengths=false if the law's gap at rest contains a length"
    )
