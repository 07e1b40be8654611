"""Control of vehicles in a SUMO scenario by a model, which sets their speeds in every step."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nnode.errors import ConfigError
from nnode.exchange.drivers import Drivers, drivable
from nnode.exchange.running_sumo import RunningSumo, Steps
from nnode.model import System

#: SUMO's output, which ``data=sumo`` reads.
TRAJECTORIES = "fcd.xml.gz"


@dataclass(kw_only=True)
class Drive:
    """The result of a simulation with controlled vehicles.

    Attributes:
        trajectories: floating car data of all vehicles.
        driven: number of controlled vehicles.
        seconds: simulated time, s.
        steps: number of steps.
        step, method: length, s, and method of a step.
        mean_speed: mean speed of the controlled vehicles over vehicles and time, m/s; None if
            there was none.
        collisions: number of pairs of vehicles that collided.
        driven_collisions: number of those pairs with a controlled vehicle.
        teleports: number of vehicles that SUMO teleported.
        stranded: number of controlled vehicles that SUMO stopped at the end of their lane.
        wall: wall time, s.
        in_sumo: part of the wall time in SUMO's steps, s.
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
    forced_steps: Steps | None = None,
    end: float | None = None,
    far: float | None = None,
    lengths: bool = True,
    lane_changes: bool = False,
    seed: int = 0,
    steer: Callable[[RunningSumo], None] | None = None,
) -> Drive:
    """Control vehicles in SUMO by a lane model.

    Args:
        system: a model that is a formula.
        scenario: SUMO's configuration.
        types: types of the controlled vehicles.
        folder: folder for :data:`TRAJECTORIES`.
        program: ``libsumo`` or ``traci``.
        expected: steps of the model's calibration, which the scenario must have; None allows any.
        forced_steps: steps that SUMO must use; None takes the scenario's.
        end: end on SUMO's clock, s; None takes the scenario's, or the arrival of all vehicles.
        far, lengths, seed: see :class:`nnode.exchange.drivers.Drivers`.
        lane_changes: whether SUMO may change lanes of controlled vehicles.
        steer: function that is called before every step, for example to control other vehicles.

    Raises:
        ConfigError: SUMO, the scenario or the model is not suitable; the message names it.
        SimulationError: the law's speed is not finite.
    """
    order = drivable(system).order
    folder.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    result = Drive(trajectories=folder / TRAJECTORIES)
    with closing(RunningSumo(program, scenario, result.trajectories, forced_steps)) as sumo:
        sumo.check_types(types)
        steps = _steps(sumo, order, scenario)
        if expected is not None:
            check_steps(steps, expected, scenario)
        drivers = Drivers(system, steps.seconds, steps.method, far=far, lengths=lengths, seed=seed)
        job = _Job(sumo, drivers, types, lane_changes)
        while sumo.continues(end):
            if steer is not None:
                steer(sumo)
            job.step(result)
    job.count(result)
    result.step, result.method = steps.seconds, steps.method
    result.seconds = result.steps * steps.seconds
    result.wall = time.perf_counter() - start
    return result


def check_steps(steps: Steps, expected: Steps, scenario: Path) -> None:
    """Refuse a scenario whose steps differ from those of a model's calibration.

    Raises:
        ConfigError: the steps differ.
    """
    same = abs(steps.seconds - expected.seconds) <= 1e-9 and steps.method == expected.method
    if not same:
        raise ConfigError(
            f"{scenario} has {steps}, the run was calibrated with {expected}; set step-length and "
            "step-method.ballistic in the scenario, take steps=run for the run's steps or "
            "steps=scenario for those of the scenario, or calibrate again with "
            f"solver.dt={steps.seconds:g} solver.method={steps.method}"
        )


def _steps(sumo: RunningSumo, order: int, scenario: Path) -> Steps:
    """SUMO's steps, with the name of the method in :data:`nnode.model.steps.METHODS`.

    Raises:
        ConfigError: ballistic steps for a law of first order.
    """
    if order == 1 and sumo.ballistic:
        raise ConfigError(
            f"{scenario} has step-method.ballistic, which moves vehicles with the mean of two "
            "speeds; a law of first order needs SUMO's default, Euler's steps"
        )
    if order == 1:
        return Steps(sumo.seconds, "euler")
    return Steps(sumo.seconds, "ballistic" if sumo.ballistic else "semi_implicit")


class _Job:
    """The controlled vehicles, in the order of the drivers, and statistics."""

    def __init__(
        self, sumo: RunningSumo, drivers: Drivers, types: Sequence[str], lane_changes: bool
    ) -> None:
        self._sumo, self._drivers = sumo, drivers
        self._types, self._lane_changes = set(types), lane_changes
        self._names: list[str] = []
        self._zero = np.empty(0)  # m, positions along the lane at the departure
        self._every: set[str] = set()
        self._crashed: set[tuple[str, str]] = set()
        self._stranded: set[str] = set()
        self._speeds, self._number = 0.0, 0
        self._take(sumo.vehicles)

    def step(self, result: Drive) -> None:
        """Set the speeds of controlled vehicles, and run a step of SUMO."""
        sumo, drivers, subscribed = self._sumo, self._drivers, self._sumo.subscriptions()
        stays = np.array([name in subscribed for name in self._names], bool)
        if not stays.all():
            drivers.keep(stays)
            self._zero = self._zero[stays]
            self._names = [name for name in self._names if name in subscribed]
        if self._names:
            views = sumo.driver_inputs(self._names, subscribed, second=drivers.needs_second_leader)
            if drivers.depends_on_position:
                views.x[:] = self._zero + sumo.places(self._names, subscribed)[1]
            sumo.set_speeds(self._names, drivers.speeds(sumo.time, views))
            self._speeds += float(views.v.sum())
            self._number += len(self._names)
        before = time.perf_counter()
        sumo.step()
        result.in_sumo += time.perf_counter() - before
        result.steps += 1
        simulation = sumo.api.simulation
        result.teleports += simulation.getStartingTeleportNumber()
        self._crashed.update((c.collider, c.victim) for c in simulation.getCollisions())
        # vehicles that SUMO stopped at the end of their lane
        self._stranded.update(simulation.getEmergencyStoppingVehiclesIDList())
        self._take(simulation.getDepartedIDList())

    def _take(self, vehicles: Sequence[str]) -> None:
        """Take control of vehicles of the controlled types."""
        taken = [name for name in vehicles if self._sumo.type_of(name) in self._types]
        if not taken:
            return
        for name in taken:
            self._sumo.take(name, lane_changes=self._lane_changes)
        self._drivers.enter([self._sumo.classes_of(name) for name in taken])
        lane, driven = self._sumo.places(taken, self._sumo.subscriptions())
        self._zero = np.concatenate([self._zero, lane - driven])
        self._names += taken
        self._every.update(taken)

    def count(self, result: Drive) -> None:
        """Add the numbers of vehicles and their mean speed to a result."""
        result.driven = len(self._every)
        result.mean_speed = self._speeds / self._number if self._number else None
        result.collisions = len(self._crashed)
        result.driven_collisions = sum(not self._every.isdisjoint(p) for p in self._crashed)
        result.stranded = len(self._stranded & self._every)
