"""Interface to a running SUMO: steps, positions, leaders and commanded speeds.

It uses ``libsumo`` in this process or ``traci`` with another process, which have the same
functions.
"""

from __future__ import annotations

import importlib
import os
import shutil
import sys
from collections.abc import Iterable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from nnode.errors import ConfigError, unknown_value
from nnode.exchange.drivers import DriverInputs

#: Supported programs.
PROGRAMS = ("libsumo", "traci")
#: Largest distance of a vehicle ahead that SUMO reports, m.
MAX_DISTANCE = 5000.0
#: Number of decimals of SUMO's output, for exact trajectories.
DIGITS = 9
#: SUMO's values for vehicles off the road are far below this.
_OFF_ROAD = -1e6

#: Vehicle to its subscribed values, by SUMO's numbers of quantities.
Subscriptions = dict[str, dict[int, Any]]


@dataclass(frozen=True)
class Steps:
    """Steps of a program: length, s, and method, one of :data:`nnode.model.steps.METHODS`."""

    seconds: float
    method: str

    def __str__(self) -> str:
        return f"{self.method} steps of {self.seconds:g} s"


class RunningSumo:
    """A scenario that SUMO has loaded.

    Args:
        program: one of :data:`PROGRAMS`.
        scenario: ``.sumocfg``.
        output: file for floating car data.
        steps: steps that SUMO must use; None takes the scenario's.

    Raises:
        ConfigError: the program or the file does not exist, or SUMO cannot load it.
    """

    def __init__(
        self, program: str, scenario: Path, output: Path, steps: Steps | None = None
    ) -> None:
        if not scenario.is_file():
            raise ConfigError(
                f"sumo={scenario} is not there; state a SUMO configuration, *.sumocfg"
            )
        self.api, binary = _loaded(program)
        options = [
            "-c",
            str(scenario),
            "--fcd-output",
            str(output),
            "--fcd-output.attributes",
            "id,type,speed,pos,lane",
            "--precision",
            str(DIGITS),
            "--no-step-log",
            "true",
            # a law may stop closer than the type's minGap, so collisions are contacts of bodies
            "--collision.mingap-factor",
            "0",
            "--aggregate-warnings",
            "3",
        ]
        if steps is not None:
            ballistic = str(steps.method == "ballistic").lower()
            options += ["--step-length", repr(steps.seconds), "--step-method.ballistic", ballistic]
        try:
            with redirect_stdout(StringIO()):  # traci prints its attempts to connect
                # a unique label, because traci keeps the label of a failed start
                self.api.start([binary, *options], label=uuid4().hex)
        except (self.api.TraCIException, self.api.FatalTraCIError) as error:
            raise ConfigError(f"sumo={scenario} cannot be loaded by SUMO: {error}") from error
        self._constants = self.api.constants
        self._length = cache(self.api.vehicle.getLength)
        self._min_gap = cache(self.api.vehicle.getMinGap)

    @property
    def ballistic(self) -> bool:
        return str(self.api.simulation.getOption("step-method.ballistic")) == "true"

    @property
    def seconds(self) -> float:
        """Length of a step, s."""
        return float(self.api.simulation.getDeltaT())

    @property
    def time(self) -> float:
        """Clock time, s, of the present positions in SUMO's output."""
        return float(self.api.simulation.getTime()) - self.seconds

    def continues(self, end: float | None) -> bool:
        """Whether there are present or future vehicles, before the end, s."""
        last = float(self.api.simulation.getEndTime()) if end is None else end
        soon = last < 0 or self.api.simulation.getTime() < last - self.seconds / 2
        return soon and self.api.simulation.getMinExpectedNumber() > 0

    def check_types(self, types: Sequence[str]) -> None:
        """Refuse unknown types, and types whose vehicles do not decide in every step.

        Raises:
            ConfigError: a type is not suitable.
        """
        every = self.api.vehicletype.getIDList()
        types_of_scenario = [name for name in every if not name.startswith("DEFAULT_")]
        for name in types:
            if name not in types_of_scenario:
                raise ConfigError(
                    f"vehicles={name} is no vehicle type of the scenario, it has "
                    f"{', '.join(types_of_scenario) or 'none'}"
                )
            pause = float(self.api.vehicletype.getActionStepLength(name))
            if pause > self.seconds * (1 + 1e-9):
                raise ConfigError(
                    f"vehicles={name}: its actionStepLength is {pause:g} s and SUMO's step "
                    f"{self.seconds:g} s, so speeds would be delayed; remove actionStepLength from "
                    "the vType"
                )

    def step(self) -> None:
        self.api.simulationStep()

    @property
    def vehicles(self) -> tuple[str, ...]:
        """All vehicles on the road."""
        return tuple(self.api.vehicle.getIDList())

    def type_of(self, vehicle: str) -> str:
        return str(self.api.vehicle.getTypeID(vehicle))

    def classes_of(self, vehicle: str) -> set[str]:
        """A vehicle's type, which ``data=sumo`` reads as its kind, and SUMO's vehicle class."""
        return {self.type_of(vehicle), str(self.api.vehicle.getVehicleClass(vehicle))}

    def take(self, vehicle: str, *, lane_changes: bool) -> None:
        """Take control of a vehicle's speed, and unless ``lane_changes`` of its lane."""
        vehicles, c = self.api.vehicle, self._constants
        vehicles.setSpeedMode(vehicle, 0)
        if not lane_changes:
            vehicles.setLaneChangeMode(vehicle, 0)
        vehicles.subscribe(vehicle, [c.VAR_SPEED, c.VAR_DISTANCE, c.VAR_LANEPOSITION])
        vehicles.subscribeLeader(vehicle, MAX_DISTANCE)

    def set_speeds(self, vehicles: Iterable[str], speeds: np.ndarray) -> None:
        """Command speeds at the end of the step that begins now, m/s."""
        for vehicle, speed in zip(vehicles, speeds.tolist(), strict=True):
            self.api.vehicle.setSpeed(vehicle, speed)

    def subscriptions(self) -> Subscriptions:
        """Subscribed values of controlled vehicles that have not arrived."""
        results: Subscriptions = self.api.vehicle.getAllSubscriptionResults()
        return results

    def driver_inputs(
        self, vehicles: Sequence[str], subscribed: Subscriptions, *, second: bool
    ) -> DriverInputs:
        """Inputs of the law for vehicles; teleported vehicles have no vehicle ahead.

        Args:
            subscribed: see :meth:`subscriptions`.
            second: whether the second vehicle ahead is needed.
        """
        speed, leader = self._constants.VAR_SPEED, self._constants.VAR_LEADER
        n = len(vehicles)
        number = {vehicle: i for i, vehicle in enumerate(vehicles)}
        v = np.array([max(subscribed[vehicle][speed], 0.0) for vehicle in vehicles])
        gap, v_1, length, lead = np.full(n, np.inf), v.copy(), np.zeros(n), np.full(n, -1)
        gap_1, v_2 = np.full(n, np.inf), v.copy()
        others: dict[str, float] = {}
        for i, vehicle in enumerate(vehicles):
            ahead = subscribed[vehicle][leader]
            if not ahead or not ahead[0] or subscribed[vehicle][speed] < _OFF_ROAD:
                continue
            name = ahead[0]
            length[i] = self._length(name)
            # SUMO's distance excludes minGap
            gap[i] = ahead[1] + self._min_gap(vehicle) + length[i]
            at = number.get(name, -1)
            if at < 0 and name not in others:
                others[name] = max(self.api.vehicle.getSpeed(name), 0.0)
            lead[i], v_1[i] = at, v[at] if at >= 0 else others[name]
            after = self.api.vehicle.getLeader(name, MAX_DISTANCE) if second and at < 0 else None
            if after and after[0]:
                gap_1[i] = after[1] + self._min_gap(name) + self._length(after[0])
                v_2[i] = max(self.api.vehicle.getSpeed(after[0]), 0.0)
        led = np.flatnonzero(lead >= 0)
        gap_1[led], v_2[led] = gap[lead[led]], v_1[lead[led]]
        return DriverInputs(
            v=v, gap=gap, v_1=v_1, length_1=length, lead=lead, gap_1=gap_1, v_2=v_2, x=np.zeros(n)
        )

    def places(self, vehicles: Sequence[str], subscribed: Subscriptions) -> np.ndarray:
        """``(2, n)``: position along the lane, and distance since the departure, m."""
        keys = (self._constants.VAR_LANEPOSITION, self._constants.VAR_DISTANCE)
        return np.array([[subscribed[vehicle][key] for vehicle in vehicles] for key in keys])

    def close(self) -> None:
        self.api.close()


def _loaded(program: str) -> tuple[Any, str]:
    """The Python module, and SUMO's executable.

    Raises:
        ConfigError: the program is unknown or not installed.
    """
    if program not in PROGRAMS:
        raise unknown_value("program", program, PROGRAMS)
    try:
        home = importlib.import_module("sumo").SUMO_HOME
    except ImportError:
        home = os.environ.get("SUMO_HOME")
    binary = shutil.which("sumo")
    if home:
        if (tools := str(Path(home, "tools"))) not in sys.path:
            sys.path.append(tools)  # traci comes with SUMO
        binary = str(Path(home, "bin", "sumo"))
    try:
        # libsumo warns of other versions of pyarrow, which only matters for its table output
        with redirect_stdout(StringIO()):
            module = importlib.import_module(program)
    except ImportError as error:
        raise ConfigError(
            f"program={program} cannot be loaded ({error}); pip install nnode[sumo], or take "
            f"program={PROGRAMS[program == PROGRAMS[0]]}"
        ) from error
    if binary is None and program == "traci":
        raise ConfigError(
            "the program sumo is not installed; pip install eclipse-sumo, or set SUMO_HOME"
        )
    return module, binary or "sumo"
