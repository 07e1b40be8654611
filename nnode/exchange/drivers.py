"""Speeds by a model for vehicles that another program moves."""

from __future__ import annotations

import copy
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nnode.errors import ConfigError, SimulationError
from nnode.model import System, Traffic
from nnode.model.arrays import Formulas
from nnode.model.effects.base import IndividualEffect
from nnode.model.effects.lane import VehicleClass
from nnode.model.expression import symbol, symbols, topological
from nnode.model.lane_rates import Rates
from nnode.model.steps import stepped
from nnode.model.term import Term
from nnode.model.terms import LaneDynamics, parameter_values

#: Gaps of an empty road, m. The law of a model must have the same values at both.
EMPTY = (1e6, 1e9)
#: Tolerance of this, m/s and m/s², absolute and relative.
_SAME = 1e-3
#: Speeds, m/s, at which this is tested.
_SPEEDS = (0.0, 5.0, 15.0, 30.0)
#: Gaps are computed as inputs, because positions may start again on every edge of a road.
_GAPS = (symbol("x_1") - symbol("x"), symbol("x_2") - symbol("x_1"))
#: Smallest random factor on a driver's pace or time gap.
_SLOWEST = 0.1


@dataclass(frozen=True, kw_only=True)
class DriverInputs:
    """Inputs of n drivers at one time, ``(n,)`` each.

    Attributes:
        v: speeds of the drivers, m/s.
        gap: gap to the vehicle ahead, front to front, m; infinite without one.
        v_1, length_1: speed, m/s, and length, m, of the vehicle ahead.
        lead: index of the vehicle ahead among the drivers; -1 if it is not among them.
        gap_1, v_2: gap, m, and speed, m/s, of the second vehicle ahead; infinite without one.
        x: positions, m, for laws that depend on them.
    """

    v: np.ndarray
    gap: np.ndarray
    v_1: np.ndarray
    length_1: np.ndarray
    lead: np.ndarray
    gap_1: np.ndarray
    v_2: np.ndarray
    x: np.ndarray


class Drivers:
    """Vehicles with the same model and separate states, delays and random numbers.

    A vehicle keeps its states if its leader changes. Without a vehicle ahead within ``far``, the
    law's leader is at the distance ``far``, or very far away if ``far`` is None, with the
    vehicle's speed.

    Args:
        system: a lane model.
        dt: step of the other program, s.
        method: method by which it moves vehicles, ``semi_implicit`` or ``ballistic``; ignored for
            laws of first order, whose vehicles move with the law's speed.
        far: largest considered distance of a vehicle ahead, m.
        lengths: whether gaps were calibrated bumper to bumper; otherwise they contain a length.
        seed: seed of the random numbers of drivers.

    Raises:
        ConfigError: a crowd model; code that is not a formula; inputs that only recorded data have;
            or ``far`` is None and the law has no limit for large gaps.
    """

    def __init__(
        self,
        system: System,
        dt: float,
        method: str,
        *,
        far: float | None = None,
        lengths: bool = True,
        seed: int = 0,
    ) -> None:
        if far is not None and not 0 < far < EMPTY[0]:
            raise ConfigError(f"far={far} must be a distance in m, below {EMPTY[0]:g}, or null")
        lane = drivable(system)
        self._system = copy.deepcopy(system).double()
        self._terms = self._system.term_list
        self.lane, self.dt = stepped(lane, method), dt
        self._far, self._lengths = EMPTY[1] if far is None else far, lengths
        self._rng = np.random.default_rng(seed)
        values = parameter_values(self._terms, lane)
        self._fixed = {name: float(value.detach()) for name, value in values.items()}
        self._added = list(lane.rates)[lane.order :]
        self._states = {state: np.empty(0) for state in self._added}
        self._inputs = {name: np.empty(0) for name in lane.inputs}
        self._begun, self._fresh = np.empty(0), np.empty(0, bool)
        self._rates = self._formulas()
        if far is None:
            self._check_empty(lane)

    def __len__(self) -> int:
        return len(self._begun)

    @property
    def depends_on_position(self) -> bool:
        """Whether speeds depend on positions and not only on gaps."""
        outputs = [*self._rates.after.outputs, *self.lane.starts.values()]
        named = {part.value for part in topological(outputs, set(_GAPS))}
        return not {"x", "x_1", "x_2"}.isdisjoint(named)

    @property
    def needs_second_leader(self) -> bool:
        """Whether the law or its start depends on the second vehicle ahead."""
        at_start = symbols(self.lane.starts.values())
        return "x_2" in at_start or any(j == 2 for _, j in self.lane.ahead)

    def enter(self, kinds: Sequence[Collection[str]]) -> None:
        """Append drivers.

        Args:
            kinds: names of the classes of each driver.
        """
        n = len(kinds)
        for name, (place, _) in self.lane.inputs.items():
            values = drawn(self._terms[place], kinds, self._rng)
            self._inputs[name] = np.concatenate([self._inputs[name], values])
        for state, memories in self._states.items():
            self._states[state] = np.concatenate([memories, np.zeros(n)])
        self._begun = np.concatenate([self._begun, np.zeros(n)])
        self._fresh = np.concatenate([self._fresh, np.ones(n, bool)])

    def keep(self, stays: np.ndarray) -> None:
        """Remove drivers.

        Args:
            stays: ``(n,)`` True for the drivers that stay.
        """
        for values_by_name in (self._states, self._inputs):
            values_by_name.update({name: values[stays] for name, values in values_by_name.items()})
        self._begun, self._fresh = self._begun[stays], self._fresh[stays]

    def speeds(self, time: float, views: DriverInputs) -> np.ndarray:
        """``(n,)`` speeds, m/s, at the end of the step that begins now; never negative.

        Args:
            time: clock time, s.

        Raises:
            SimulationError: a speed or a state is not finite.
        """
        speed = self._advanced(time, views)
        bad = ~np.isfinite([speed, *self._states.values()]).all(0)
        if bad.any():
            i = int(bad.argmax())
            raise SimulationError(
                f"the law has no finite value at {time:g} s for v = {views.v[i]:g} m/s and a gap "
                f"of {views.gap[i]:g} m; take a shorter step, or other parameters"
            )
        return np.maximum(speed, 0.0)

    def _advanced(self, time: float, views: DriverInputs) -> np.ndarray:
        """``(n,)`` the law's speeds at the end of the step; also advances the added states."""
        given = self._given(time, views)
        if self._fresh.any():
            self._begin(time, views, given)
        top, *others = self._rates_of(given)
        for state, rate in zip(self._added, others, strict=True):
            self._states[state] = self._states[state] + self.dt * rate
        speed: np.ndarray = top if self.lane.order == 1 else given["v"] + self.dt * top
        return speed

    def _formulas(self) -> Rates:
        """The rates of the law and of added states."""
        return Rates([self.lane.rates[s] for s in (self.lane.top, *self._added)], _GAPS)

    def _rates_of(self, given: dict[str, Any]) -> list[np.ndarray]:
        """``(n,)`` each: the rates. Chained rates are computed after those of the vehicle ahead."""
        n, lead = len(self), given["lead"]
        ready = [np.broadcast_to(part, n) for part in self._rates.at_once(given, given["gaps"])]
        if not self._rates.chained:
            return ready
        chained: list[np.ndarray] = []
        ahead = np.array(given["dx_1"])
        for group in leaders_first(lead):
            led = group[lead[group] >= 0]
            if chained:
                ahead[led] = np.maximum(chained[0][lead[led]], 0.0)
            rates = self._rates.after({"dx_1": ahead[group]}, [part[group] for part in ready])
            chained = chained or [np.empty(n) for _ in rates]
            for target, rate in zip(chained, rates, strict=True):
                target[group] = rate
        return chained

    def _given(self, time: float, views: DriverInputs) -> dict[str, Any]:
        """Values of all symbols and gaps."""
        n = len(self)
        follows = views.gap <= self._far
        second = follows & np.isfinite(views.gap_1)
        gap = np.where(follows, views.gap, self._far)
        gap_1 = np.where(second, views.gap_1, self._far)
        v_1 = np.where(follows, views.v_1, views.v)
        length = views.length_1 if self._lengths else np.zeros(n)
        start = np.where(self._fresh, time, self._begun)
        return {
            **self._fixed,
            **self._states,
            **self._inputs,
            "x": views.x,
            "x_1": views.x + gap,
            "x_2": views.x + gap + gap_1,
            "v": views.v,
            "v_1": v_1,
            "v_2": np.where(second, views.v_2, v_1),
            "dx_1": v_1,
            "length_1": np.where(follows, length, 0.0),
            "second": second.astype(float),
            "t": time - start,
            "start": start,
            "dt": np.full(n, self.dt),
            "gaps": (gap, gap_1),
            "lead": np.where(follows, views.lead, -1),
        }

    def _begin(self, time: float, views: DriverInputs, given: dict[str, Any]) -> None:
        """Initialise the states of new drivers."""
        new = self._fresh
        self._begun = given["start"]
        starts = self.lane.starts
        values = Formulas(starts.values(), _GAPS)(given, given["gaps"])
        for state, start in zip(starts, values, strict=True):
            self._states[state] = np.where(new, start, self._states[state])
            given[state] = self._states[state]
        self._fresh = np.zeros(len(self), bool)

    @np.errstate(all="ignore")
    def _check_empty(self, lane: LaneDynamics) -> None:
        """Refuse a law without a limit for large gaps.

        Args:
            lane: the formula without the changes of a method of stepping.
        """
        v = np.array(_SPEEDS)
        inf, zero = np.full_like(v, np.inf), np.zeros_like(v)
        views = DriverInputs(
            v=v, gap=inf, v_1=v, length_1=zero, lead=zero.astype(int) - 1, gap_1=inf, v_2=v, x=zero
        )
        results = []
        for far in EMPTY:
            trial = copy.copy(self)
            trial._far, trial.lane = far, lane
            trial._rates = trial._formulas()
            trial._states, trial._inputs = dict(self._states), dict(self._inputs)
            trial._rng = np.random.default_rng(0)
            trial.enter([()] * len(v))
            results.append([trial._advanced(k * self.dt, views) for k in range(3)])
            results[-1] += list(trial._states.values())
        same = all(
            (np.abs(a - b) <= _SAME * (1 + np.abs(b))).all() for a, b in zip(*results, strict=True)
        )
        if not same:
            raise ConfigError(
                f"{' with '.join(str(term.name) for term in self._terms)} has no speed on an "
                "empty road, because its value or a state grows with the gap; set a distance such "
                "as far=100 (m): vehicles farther ahead are ignored, and without a vehicle ahead "
                "the law has a leader at this distance with the same speed"
            )


def leaders_first(lead: np.ndarray) -> list[np.ndarray]:
    """Groups of indices of vehicles, such that leaders come before their followers.

    Args:
        lead: ``(n,)`` index of the leader; -1 for none. A ring starts at an arbitrary vehicle.
    """
    done = lead < 0
    groups = [np.flatnonzero(done)] if done.any() else []
    while not done.all():
        ready = ~done & done[lead]
        if not ready.any():
            ready[int(done.argmin())] = True
        groups.append(np.flatnonzero(ready))
        done = done | ready
    return groups


def drivable(system: System) -> LaneDynamics:
    """The formula of a model that can control vehicles in another program.

    Raises:
        ConfigError: the model has no formula, or needs inputs that only recorded data have.
    """
    if not isinstance(system, Traffic):
        raise ConfigError(
            "the run's model is one of people, and nnode drive controls vehicles in SUMO; "
            "JuPedSim cannot run a user's model, and nnode export to=jupedsim writes the "
            "parameters of its own models"
        )
    lane = system.formula
    if type(system) is not Traffic or lane is None or not lane.is_formula:
        raise ConfigError(
            "the run's model has a term that is Python code, and only formulas can control "
            "vehicles, see docs/method.md"
        )
    if "measured" in symbols([*lane.rates.values(), *lane.starts.values()]):
        raise ConfigError(
            "the run's model depends on measured speeds, which vehicles in SUMO do not have"
        )
    for place, part in lane.inputs.values():
        term = system.terms[place]
        if not isinstance(term, VehicleClass | IndividualEffect):
            raise ConfigError(
                f"effect {term.name} needs {part} of each vehicle from the recorded data, which "
                "SUMO cannot tell; calibrate a model without the effect"
            )
    return lane


def drawn(term: Term, kinds: Sequence[Collection[str]], rng: np.random.Generator) -> np.ndarray:
    """``(n,)`` inputs of new drivers for an effect.

    They are 1 for members of the effect's class, or numbers from the effect's normal distribution,
    which are at least -0.9.
    """
    if isinstance(term, VehicleClass):
        return np.array([float(term.kind in names) for names in kinds])
    assert isinstance(term, IndividualEffect)
    estimates = np.concatenate([np.zeros(0), *(np.array(names) for names in term.people.values())])
    (strength, *_) = term.strengths
    spread = float(getattr(term, strength).detach())
    if not spread and len(estimates):
        spread = float(np.sqrt(np.mean(estimates**2)))
    return np.maximum(rng.normal(0.0, 1.0, len(kinds)) * spread, _SLOWEST - 1)
