"""A model drives vehicles of a scenario in SUMO: every step their speeds are set."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nnode.errors import ConfigError
from nnode.exchange.drivers import Drivers, drivable
from nnode.exchange.running_sumo import RunningSumo, Steps
from nnode.model import System

#: What SUMO writes, which ``data=sumo`` reads.
TRAJECTORIES = "fcd.xml.gz"


@dataclass(kw_only=True)
class Drive:
    """What came of it.

    Attributes:
        trajectories: floating car data of all vehicles.
        driven: number of vehicles that the model has driven.
        seconds: simulated, s; steps: how many; step, method: each of them.
        mean_speed: of the driven vehicles, over vehicles and time, m/s; None: there was none.
        collisions: pairs of vehicles of which one ran into the other; driven_collisions: those
            with a driven one.
        teleports: vehicles that SUMO carried elsewhere.
        stranded: driven vehicles that SUMO stopped where their lane did not lead on.
        wall: s that it took; in_sumo: of these within SUMO's own steps.
    """

    trajectories: Path
    driven: int = 0
    seconds: float = 0.0
    steps: int = 0
    step: float = 0.0
    method: str = ""
    mean_speed: float | None = None
    collisions: int = 0
    driven_collisions: int = 0
    teleports: int = 0
    stranded: int = 0
    wall: float = 0.0
    in_sumo: float = 0.0


def drive(
    system: System,
    scenario: Path,
    types: Sequence[str],
    folder: Path,
    *,
    program: str = "libsumo",
    expected: Steps | None = None,
    told: Steps | None = None,
    end: float | None = None,
    far: float | None = None,
    lengths: bool = True,
    lane_changes: bool = False,
    seed: int = 0,
    steer: Callable[[RunningSumo], None] | None = None,
) -> Drive:
    """Let a lane's model drive vehicles in SUMO.

    Args:
        system: a model that is a formula.
        scenario: SUMO's configuration.
        types: of the vehicles to drive.
        folder: receives :data:`TRAJECTORIES`.
        program: ``libsumo`` or ``traci``.
        expected: the steps that the model was calibrated with; None: any are taken.
        told: SUMO is told to make these steps; None: the scenario's.
        end: s of SUMO's clock; None: the scenario's, or when everybody has arrived.
        far, lengths, seed: see :class:`nnode.exchange.drivers.Drivers`.
        lane_changes: whether SUMO may change lanes of driven vehicles.
        steer: is called before every step, as for vehicles that somebody else drives.

    Raises:
        ConfigError: what does not fit; SUMO, the scenario or the model are named.
        SimulationError: the law says no finite number.
    """
    order = drivable(system).order
    folder.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    sumo = RunningSumo(program, scenario, folder / TRAJECTORIES, told)
    try:
        sumo.check_types(types)
        steps = _steps(sumo, order, scenario)
        if expected is not None:
            check_steps(steps, expected, scenario)
        drivers = Drivers(system, steps.seconds, steps.method, far=far, lengths=lengths, seed=seed)
        job = _Job(sumo, drivers, types, lane_changes)
        while sumo.going_on(end):
            if steer is not None:
                steer(sumo)
            job.step()
        result = job.found(folder / TRAJECTORIES)
    finally:
        sumo.close()
    result.step, result.method = steps.seconds, steps.method
    result.seconds = result.steps * steps.seconds
    result.wall = time.perf_counter() - started
    return result


def check_steps(steps: Steps, expected: Steps, scenario: Path) -> None:
    """Refuse a scenario whose steps are not those that a model was calibrated with.

    Raises:
        ConfigError: says both, and what to do.
    """
    same = abs(steps.seconds - expected.seconds) <= 1e-9 and steps.method == expected.method
    if not same:
        raise ConfigError(
            f"{scenario} makes {steps}, the run was calibrated with {expected}; set step-length "
            "and step-method.ballistic in the scenario, take steps=run for SUMO to make the run's, "
            "steps=scenario to go on with those of the scenario, or calibrate again with "
            f"solver.dt={steps.seconds:g} solver.method={steps.method}"
        )


def _steps(sumo: RunningSumo, order: int, scenario: Path) -> Steps:
    """What SUMO makes, in the words of the laws.

    Raises:
        ConfigError: a law of first order and ballistic steps.
    """
    if order == 1 and sumo.ballistic:
        raise ConfigError(
            f"{scenario} has step-method.ballistic, which places vehicles with the mean of two "
            "speeds; the run's law says a speed and needs SUMO's default, Euler's steps"
        )
    if order == 1:
        return Steps(sumo.seconds, "euler")
    return Steps(sumo.seconds, "ballistic" if sumo.ballistic else "semi_implicit")


class _Job:
    """The vehicles that are driven, in the order of the drivers, and what is counted."""

    def __init__(
        self, sumo: RunningSumo, drivers: Drivers, types: Sequence[str], lane_changes: bool
    ) -> None:
        self._sumo, self._drivers = sumo, drivers
        self._types, self._lane_changes = set(types), lane_changes
        self._names: list[str] = []
        self._zero = np.empty(0)  # m along the lane where the way began
        self._every: set[str] = set()
        self._crashed: set[tuple[str, str]] = set()
        self._stranded: set[str] = set()
        self._teleports, self._steps, self._in_sumo = 0, 0, 0.0
        self._speeds, self._number = 0.0, 0
        self._take(sumo.vehicles)

    def step(self) -> None:
        """Speeds for those who are driven, and a step of SUMO's."""
        sumo, drivers, subscribed = self._sumo, self._drivers, self._sumo.told()
        stays = np.array([name in subscribed for name in self._names], bool)
        if not stays.all():
            drivers.keep(stays)
            self._zero = self._zero[stays]
            self._names = [name for name in self._names if name in subscribed]
        if self._names:
            views = sumo.seen(self._names, subscribed, twice=drivers.looks_twice)
            if drivers.depends_on_position:
                views.x[:] = self._zero + sumo.places(self._names, subscribed)[1]
            sumo.set_speeds(self._names, drivers.speeds(sumo.time, views))
            self._speeds += float(views.v.sum())
            self._number += len(self._names)
        before = time.perf_counter()
        sumo.step()
        self._in_sumo += time.perf_counter() - before
        self._steps += 1
        self._crashed.update(sumo.collisions())
        self._stranded.update(sumo.stranded())
        self._teleports += sumo.teleports()
        self._take(sumo.departed)

    def _take(self, vehicles: Sequence[str]) -> None:
        """Take over vehicles of the types."""
        taken = [name for name in vehicles if self._sumo.type_of(name) in self._types]
        if not taken:
            return
        for name in taken:
            self._sumo.take(name, lane_changes=self._lane_changes)
        self._drivers.enter([self._sumo.classes_of(name) for name in taken])
        lane, way = self._sumo.places(taken, self._sumo.told())
        self._zero = np.concatenate([self._zero, lane - way])
        self._names += taken
        self._every.update(taken)

    def found(self, trajectories: Path) -> Drive:
        return Drive(
            trajectories=trajectories,
            driven=len(self._every),
            steps=self._steps,
            mean_speed=self._speeds / self._number if self._number else None,
            collisions=len(self._crashed),
            driven_collisions=sum(not self._every.isdisjoint(pair) for pair in self._crashed),
            teleports=self._teleports,
            stranded=len(self._stranded & self._every),
            in_sumo=self._in_sumo,
        )
