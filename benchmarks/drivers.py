"""The diagnosis of lanes where drivers differ: ``python -m benchmarks.drivers --seed N --cases K``.

Every case is ``--platoons`` platoons of ``--vehicles`` vehicles for 30 s at 5 Hz, by ``lin``,
``idm`` or ``fvdm``, in which one effect is hidden or none, or two with ``--pairs``. Drivers'
parameters are log-normal (``lin``: v0; ``idm``: T and v0; ``fvdm``: s_c and v0) with a standard
deviation of ``--spread`` %, pushes last 4 s, and positions are measured with errors of ``--error``
m. ``--nature`` and ``--push`` depart from this. With ``--nothing``, nothing is hidden in any case,
and with ``--effects`` one of the named effects in every case. Paths are integrated here by Euler's
method; everything else is the package's public interface. The cases of a run are fixed by its seed.
The table has a row per case; the last lines count right and false answers, with exact intervals of
95 %. Laws are not compared before a diagnosis; with ``--default`` they are, as in every diagnosis
by default. ``--compare`` only compares laws. ``--calibrate`` only calibrates, with nothing hidden;
the last lines count intervals that contain the true value.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import ndtr, stdtrit

import nnode
from benchmarks.discovery.run import sources
from benchmarks.discovery.verdicts import verdicts
from benchmarks.synthetic_cases.score import covers, judged
from nnode.app.compared_laws import compared_laws
from nnode.app.python.inputs import model_options
from nnode.diagnosis import thresholds
from nnode.diagnosis.compare import compare_laws
from nnode.diagnosis.options import DiscoverOptions
from nnode.files import write_text
from nnode.model.build import build_model
from nnode.model.term import short_names
from studies.runner import Task, run_tasks

#: s, step and sampling interval, s. Steps of 0.02 s delay reactions by 0.01 s, which lowers kappa
#: of ``lin`` by 0.008. The delay of these steps lowers it by 0.001, a tenth of its standard error.
SECONDS, STEP, DT = 30.0, 0.002, 0.2
#: s between the starts of two platoons.
START = 100.0
#: s that pushes last; their standard deviation by law, m/s and m/s².
LASTS, PUSH = 4.0, {"lin": 0.3, "idm": 0.06, "fvdm": 0.06}
#: Hidden effects by law, with their sizes: factors of v0 in :data:`ZONE`, in :data:`PERIOD` and of
#: trucks (``idm``: of their T); shares; s; of ``asymmetric_response`` kappa_open, beside a
#: kappa_close of 0; m/s of ``free_flow_speed``. Platoons of ``fvdm`` with a delay of 0.6 s are
#: unstable, and vehicles collide.
HIDDEN = {
    "lin": {
        "speed_zone": 0.9,
        "relative_speed": 0.2,
        "multi_anticipation": 0.2,
        "inertia": 0.3,
        "reaction_delay": 0.3,
        "speed_period": 0.9,
        "vehicle_class": 0.85,
        "leader_length": 0.5,
        "time_gap": 0.3,
        "asymmetric_response": 0.4,
        "free_flow_speed": 17.0,
    },
    "idm": {
        "speed_zone": 0.6,
        "relative_speed": 0.2,
        "multi_anticipation": 0.2,
        "reaction_delay": 0.6,
        "speed_period": 0.6,
        "vehicle_class": 1.3,
        "leader_length": 0.5,
        "asymmetric_response": 0.4,
        "inertia": 0.5,
    },
    "fvdm": {"speed_zone": 0.8, "multi_anticipation": 0.2, "reaction_delay": 0.3},
}
#: Two effects that are hidden at once.
PAIRS = {
    "lin": ["speed_zone+relative_speed", "multi_anticipation+inertia", "speed_zone+reaction_delay"],
    "idm": ["speed_zone+relative_speed", "speed_zone+multi_anticipation"],
    "fvdm": ["speed_zone+multi_anticipation", "speed_zone+reaction_delay"],
}
#: What departs from the assumptions: desired speeds that vary by 8 % over 30 s, drivers of a skewed
#: distribution (gamma), pushes with heavy tails (Student's t of four degrees of freedom), pushes
#: that change smoothly (second-order autoregressive), errors of measurement that last for 1 s.
NATURES = ("plain", "moods", "skewed", "heavy", "smooth", "lasting")
#: Ends of the zone, m, and of the period, s.
ZONE, PERIOD = (250.0, 420.0), (1010.0, 2020.0)
#: Share of trucks, and their length, m, where an effect depends on the vehicle.
TRUCKS, TRUCK = 0.25, 12.0
V0, LENGTH, T, S0, A, B, CAR = 29.0, 6.0, 1.25, 2.0, 1.25, 1.8, 4.5
#: Parameters of ``fvdm`` besides v0: m, m, 1/s, 1/s.
S_C, W, KAPPA, LAM = 15.0, 12.0, 0.5, 0.5
#: Parameters of the typical driver, by law.
TYPICAL = {
    "lin": {"v0": V0, "L": LENGTH},
    "idm": {"v0": V0, "T": T, "s0": S0, "a": A, "b": B},
    "fvdm": {"v0": V0, "s_c": S_C, "w": W, "kappa": KAPPA, "lam": LAM},
}


def platoons(
    law: str,
    effect: str,
    spread: float,
    seed: int,
    number: int = 40,
    vehicles: int = 6,
    error: float = 0.06,
    nature: str = "plain",
    strength: float | None = None,
) -> pd.DataFrame:
    """A tidy table of measured positions, m.

    Args:
        effect: a name of :data:`HIDDEN`, several with ``+`` between, or ``none``.
        spread: standard deviation of the logarithms of drivers' parameters.
        number: of platoons. vehicles: in each. error: of measured positions, m.
        nature: one of :data:`NATURES`.
        strength: standard deviation of pushes; None: that of :data:`PUSH`.
    """
    rng, shape = np.random.default_rng(seed), (number, vehicles - 1)
    size, root = (2, *shape), np.sqrt(2.0)
    if nature == "skewed":
        factors = rng.gamma(2.0, size=size) / root * spread + 1 - spread * root
    else:
        factors = np.exp(spread * rng.normal(size=size))
    mean, phase = rng.uniform(11, 17, (number, 1)), rng.random((number, 4))
    height, period = rng.normal(0, 1.3, (number, 4)), np.array([7.0, 13.0, 21.0, 34.0])
    drivers = _Drivers(law, _sizes(law, effect), factors, rng)
    gap = drivers.equilibrium_gap(mean) * rng.uniform(0.9, 1.2, shape)
    gap += drivers.longer + (0.0 if law == "lin" else drivers.length[:, :-1] - CAR)
    x = rng.uniform(0, 300, (number, 1)) - np.insert(gap.cumsum(1), 0, 0.0, 1)
    v, pushes = np.repeat(mean, vehicles, 1), Pushes(nature, shape, rng)
    delay = round(drivers.sizes.get("reaction_delay", 0.0) / STEP)
    lag = drivers.sizes.get("inertia", STEP)
    mood, kick = np.zeros(shape), np.zeros((number, vehicles))
    past: list[tuple[np.ndarray, np.ndarray]] = []
    slow, rows = np.repeat(mean, vehicles - 1, 1), []
    for k in range(round(SECONDS / STEP) + 1):
        if k % round(DT / STEP) == 0:
            shock = rng.normal(size=kick.shape)
            kick = _next(kick, shock, DT, 1.0) if nature == "lasting" else shock
            rows.append(x + error * kick)
        angle = 2 * np.pi * (k * STEP / period + phase)
        lead = np.maximum(mean[:, 0] + (height * np.sin(angle)).sum(1), 2.0)
        v[:, 0] = lead
        past = [*past, (x, v.copy())][-delay - 1 :]
        if nature == "moods":
            mood = _next(mood, rng.normal(size=shape), STEP, 30.0)
        push = _strength(law, strength) * pushes.present()
        clock = START * np.arange(number)[:, None] + k * STEP
        wish = drivers.v0 * np.exp(0.08 * mood) * drivers.slowed(x[:, 1:], clock)
        wanted = drivers.wanted(*past[0], wish)
        # laws of second order begin with the acceleration of the first moment
        slow = wanted if k == 0 and law != "lin" else slow + STEP / lag * (wanted - slow)
        if law == "lin":
            after = np.maximum(slow + push, 0.0)
            for i, ahead in enumerate([lead, *after.T[:-1]]):  # views, which have their responses
                after[:, i] += drivers.response(ahead - slow[:, i])
            v = np.column_stack([lead, after])
            x = x + STEP * v
        else:
            after = np.maximum(v[:, 1:] + STEP * np.clip(slow + push, -8.0, 5.0), 0.0)
            x = x + STEP * np.column_stack([lead, (v[:, 1:] + after) / 2])
            v = np.column_stack([lead, after])
        pushes.advance()
    return _table(np.array(rows), drivers.columns())


class _Drivers:
    """The followers of platoons.

    Attributes:
        sizes: of the hidden effects.
        v0: ``(P, N - 1)`` desired speeds, m/s. gap: factors on T or on s_c.
        truck: ``(P, N)`` which vehicles are trucks; there are some only where an effect depends on
            them. length: of the vehicles, m.
        longer: ``(P, N - 1)`` by how much longer vehicles ahead count, m.
    """

    def __init__(
        self, law: str, sizes: dict[str, float], factors: np.ndarray, rng: np.random.Generator
    ) -> None:
        self.law, self.sizes = law, sizes
        self.v0, self.gap = V0 * factors[0], factors[1]
        number, followers = self.gap.shape
        shape = number, followers + 1
        self.truck, self.length = np.zeros(shape, bool), np.full(shape, CAR)
        if {"vehicle_class", "leader_length"} & set(sizes):
            self.truck = rng.random(shape) < TRUCKS
        if "leader_length" in sizes:
            self.length[self.truck] = TRUCK
        away = (self.length - self.length.mean())[:, :-1]
        self.longer = sizes.get("leader_length", 0.0) * away
        factor = np.where(self.truck[:, 1:], sizes.get("vehicle_class", 1.0), 1.0)
        if law == "lin":
            self.v0 = self.v0 * factor
        else:
            self.gap = self.gap * factor

    def columns(self) -> dict[str, np.ndarray]:
        """Columns of the table that vehicles have."""
        columns = {}
        if self.law != "lin" or "leader_length" in self.sizes:
            columns["length"] = self.length
        if "vehicle_class" in self.sizes:
            columns["kind"] = np.where(self.truck, "truck", "car")
        return columns

    def equilibrium_gap(self, speed: np.ndarray) -> np.ndarray:
        """Distances to the vehicle ahead, m, at which drivers keep a speed."""
        share = speed / self.v0
        if self.law == "idm":
            wish = S0 + speed * T * self.gap
            return CAR + wish / np.sqrt(np.maximum(1 - share**4, 0.2))
        if self.law == "fvdm":
            bend = np.tanh(S_C * self.gap / W)
            optimal = np.minimum(share * (1 + bend) - bend, 0.9)
            return CAR + S_C * self.gap + W * np.arctanh(optimal)
        return LENGTH / np.maximum(1 - share, 0.15)

    def slowed(self, x: np.ndarray, clock: np.ndarray) -> np.ndarray:
        """Factors on desired speeds at places and times."""
        zone = (x > ZONE[0]) & (x < ZONE[1])
        period = (clock > PERIOD[0]) & (clock < PERIOD[1])
        factor = np.where(zone, self.sizes.get("speed_zone", 1.0), 1.0)
        return factor * np.where(period, self.sizes.get("speed_period", 1.0), 1.0)

    def response(self, faster: np.ndarray) -> np.ndarray:
        """To the vehicle ahead, which is faster by some m/s."""
        opening = self.sizes.get("asymmetric_response", 0.0) * np.maximum(faster, 0.0)
        return self.sizes.get("relative_speed", 0.0) * faster + opening

    def wanted(self, x: np.ndarray, v: np.ndarray, v0: np.ndarray) -> np.ndarray:
        """Speeds by ``lin``, m/s, which have no response yet, or accelerations by ``idm`` or
        ``fvdm``, m/s².

        Args:
            v: of the step before, m/s. v0: desired speeds, m/s.
        """
        share = self.sizes.get("multi_anticipation", 0.0)
        if self.law == "lin":
            gap = np.maximum(x[:, :-1] - x[:, 1:] - self.longer, 0.6 * LENGTH)
            total = v0 * (1 - (LENGTH + self.sizes.get("time_gap", 0.0) * v[:, :-1]) / gap)
            if share:
                total[:, 1:] += share * (v0[:, 1:] * (1 - LENGTH / gap[:, :-1]) - total[:, 1:])
            return np.minimum(total, self.sizes.get("free_flow_speed", np.inf))
        ahead, length = v[:, :-1], self.length[:, :-1] + self.longer
        gap = np.maximum(x[:, :-1] - x[:, 1:] - length, 0.3)
        total = self._rate(gap, ahead, v, v0) + self.response(ahead - v[:, 1:])
        if share:
            second = np.maximum((x[:, :-2] - x[:, 2:]) / 2 - CAR, 0.3)
            total[:, 1:] += share * (self._rate(second, v[:, :-2], v, v0) - total[:, 1:])
        return total

    def _rate(
        self, gap: np.ndarray, ahead: np.ndarray, v: np.ndarray, v0: np.ndarray
    ) -> np.ndarray:
        """Accelerations by ``idm`` or ``fvdm`` of the last vehicles, one per gap."""
        first = v.shape[1] - gap.shape[1]
        own, wish, factor = v[:, first:], v0[:, first - 1 :], self.gap[:, first - 1 :]
        if self.law == "fvdm":
            place = S_C * factor
            bend = np.tanh(place / W)
            optimal = wish * (np.tanh((gap - place) / W) + bend) / (1 + bend)
            return KAPPA * (optimal - own) - LAM * (own - ahead)
        away = own * (own - ahead) / (2 * np.sqrt(A * B))
        wanted = S0 + np.maximum(own * T * factor + away, 0.0)
        return A * (1 - (own / wish) ** 4 - (wanted / gap) ** 2)


def _sizes(law: str, effect: str) -> dict[str, float]:
    """Of the effects that are hidden."""
    return {name: HIDDEN[law][name] for name in effect.split("+") if name != "none"}


class Pushes:
    """Pushes of followers, with a standard deviation of 1, that last :data:`LASTS`.

    Args:
        nature: one of :data:`NATURES`.
    """

    def __init__(self, nature: str, shape: tuple[int, int], rng: np.random.Generator) -> None:
        self._nature, self._rng = nature, rng
        self._process = rng.normal(size=shape)
        self._source = self._process / np.sqrt(2.0)  # of smooth pushes, which follow it

    def present(self) -> np.ndarray:
        """Their present values."""
        if self._nature == "heavy":
            tails: np.ndarray = stdtrit(4, ndtr(self._process)) / np.sqrt(2.0)
            return tails
        return self._process

    def advance(self) -> None:
        """Go on by a step."""
        shock = self._rng.normal(size=self._process.shape)
        if self._nature == "smooth":
            self._source = _next(self._source, shock, STEP, LASTS / 2)
            missing = np.sqrt(2.0) * self._source - self._process
            self._process = self._process + STEP / (LASTS / 2) * missing
        else:
            self._process = _next(self._process, shock, STEP, LASTS)


def _strength(law: str, given: float | None) -> float:
    """The standard deviation of pushes, m/s or m/s²."""
    return PUSH[law] if given is None else given


def _next(now: np.ndarray, shock: np.ndarray, step: float, lasts: float) -> np.ndarray:
    """The next value, ``step`` s later, of what lasts for some s and has a standard deviation of 1.

    Args:
        shock: standard normal numbers.
    """
    keep = np.exp(-step / lasts)
    return keep * now + np.sqrt(1 - keep**2) * shock


def _table(x: np.ndarray, columns: dict[str, np.ndarray]) -> pd.DataFrame:
    """A row per sample; ``columns`` are those of vehicles."""
    samples, number, agents = x.shape
    run = np.arange(number)[:, None]
    clock = DT * np.arange(samples)[:, None, None] + START * run
    agent = agents * run + np.arange(agents)
    columns = {"sequence": run, "time": clock.round(6), "x": x, "agent": agent, **columns}
    return pd.DataFrame({k: np.broadcast_to(v, x.shape).ravel() for k, v in columns.items()})


def cases(
    seed: int,
    total: int,
    spread: float,
    laws: list[str],
    pairs: bool = False,
    effects: list[str] | None = None,
    **given: Any,
) -> list[dict[str, Any]]:
    """Half of them with nothing hidden; laws and effects take turns.

    Args:
        pairs: two effects are hidden at once.
        effects: hidden in all cases, of every law those that it can have; None: half of the cases.
        given: ``number``, ``vehicles``, ``error``, ``nature`` and ``strength`` of :func:`platoons`.
    """
    chosen = []
    for k in range(total):
        turn, hides = (k // 2, k % 2 == 1) if effects is None else (k, True)
        law = laws[turn % len(laws)]
        names = PAIRS[law] if pairs else list(HIDDEN[law])
        names = [name for name in names if effects is None or name in effects]
        effect = names[turn // len(laws) % len(names)] if hides else "none"
        chosen.append({"law": law, "effect": effect, "spread": spread, "seed": seed + k} | given)
    return chosen


def evaluate(work: str, **case: Any) -> dict[str, Any]:
    """The row of a case: a diagnosis, a comparison of laws, or a calibration.

    Args:
        work: a key of :data:`WORKS`.
    """
    start = time.monotonic()
    row = {**case, "hidden": case["effect"] != "none", **WORKS[work](case)}
    return {**row, "seconds": round(time.monotonic() - start, 1)}


def _diagnosed(case: dict[str, Any], laws: list[str] | None) -> dict[str, Any]:
    """A diagnosis, and intervals of sizes and of differences between drivers.

    Args:
        laws: the laws that are compared first; None takes those of diagnoses by default.
    """
    report = nnode.diagnose(
        platoons(**case),
        "traffic",
        model=case["law"],
        options=DiscoverOptions(page=False, replay=False, compare=laws),
    ).plain()
    sizes = _sizes(case["law"], case["effect"])
    intervals = {
        effect["name"]: next(iter(effect["coefficients"].values())) for effect in report["effects"]
    } | {
        each["name"].removeprefix(f"{case['law']}."): {
            "value": each["estimate"],
            "low": each["lower"],
            "high": each["upper"],
        }
        for each in report["drivers"]
    }
    row = judged(report, list(sizes)) | {"law_at_bounds": bool(report["law_at_bounds"])}
    for name, true in {**sizes, **_variations(case)}.items():
        interval = intervals.get(name, {})
        row |= estimate_row(name, true, *(interval.get(end) for end in ("value", "low", "high")))
    return row


def _compared(case: dict[str, Any]) -> dict[str, Any]:
    """A comparison of all laws, of which the case's law should be the first."""
    sequences, options = list(nnode.sequences(platoons(**case))), DiscoverOptions()
    model = model_options(case["law"], "measured")
    laws = compared_laws(model, build_model(model), options)
    p_values = compare_laws(laws, case["law"], sequences, options)[0].p_values
    first, second, *_ = p_values
    return {
        "first": first,
        "second": second,
        "p second": p_values[second],
        "p true": p_values[case["law"]],
        "true law first": first == case["law"],
        "true law rejected": p_values[case["law"]] <= thresholds.STRICT,
    }


def _calibrated(case: dict[str, Any]) -> dict[str, Any]:
    """The estimates of a calibration, and whether their intervals contain the true parameters and
    variances."""
    run = nnode.fit(platoons(**case), "traffic", model=case["law"], drivers="auto", heldout=0.0)
    assert run.drivers is not None
    variability, variations = run.drivers.variability, _variations(case)
    parameters = run.parameters.rename(index=short_names(map(str, run.parameters.index)))
    row: dict[str, Any] = {}
    for table, true_values, what in (
        (parameters, TYPICAL[case["law"]], ""),
        (variability, variations | {"measurement": case["error"]}, ", variation"),
    ):
        rows = table.reindex(list(true_values))[["estimate", "lower", "upper"]]
        for name, values in zip(true_values, rows.to_numpy(), strict=True):
            row |= estimate_row(f"{name}{what}", true_values[name], *map(float, values))
    others = set(variability.index[variability["unit"] == "%"])
    return row | {"false variation": bool(others - set(variations))}


#: What is done with a case.
WORKS: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
    "diagnose": partial(_diagnosed, laws=[]),
    "default": partial(_diagnosed, laws=None),
    "compare": _compared,
    "calibrate": _calibrated,
}


def estimate_row(
    name: str, true: float, value: float | None, low: float | None, high: float | None
) -> dict[str, Any]:
    """An estimate, the true value, and whether its interval contains it."""
    return {name: value, f"{name}, true": true, f"{name} covered": covers(low, high, true)}


def _variations(case: dict[str, Any]) -> dict[str, float]:
    """The true standard deviations of drivers' parameters, %, and of pushes, and their time, s."""
    names = {"lin": ["v0"], "idm": ["v0", "T"], "fvdm": ["v0", "s_c"]}[case["law"]]
    return dict.fromkeys(names, 100 * case["spread"]) | {
        "push": _strength(case["law"], case.get("strength")),
        "push_time": LASTS,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, required=True, help="of the first case")
    for name, default, text in (
        ("cases", 24, "number of cases"),
        ("spread", 15.0, "between drivers, percent"),
        ("platoons", 40, "in a case"),
        ("vehicles", 6, "in a platoon, its leader included"),
        ("error", 0.06, "of measured positions, m"),
        ("processes", 2, "side by side"),
    ):
        parser.add_argument(f"--{name}", type=type(default), default=default, help=text)
    parser.add_argument("--pairs", action="store_true", help="two effects at once")
    parser.add_argument(
        "--effects", nargs="+", help="hidden in all cases, instead of in half of them"
    )
    works = parser.add_mutually_exclusive_group()
    for work, text in (
        ("compare", "only compare laws"),
        ("default", "compare laws first, as diagnoses do by default"),
        ("calibrate", "only calibrate, nothing hidden"),
    ):
        works.add_argument(f"--{work}", dest="work", action="store_const", const=work, help=text)
    parser.set_defaults(work="diagnose")
    parser.add_argument("--nothing", action="store_true", help="nothing hidden in any case")
    parser.add_argument("--nature", default="plain", choices=NATURES)
    parser.add_argument("--push", type=float, help="standard deviation of pushes, m/s or m/s²")
    parser.add_argument("--laws", nargs="+", default=["lin", "idm"], choices=list(HIDDEN))
    parser.add_argument("--table", type=Path, default=Path("runs/benchmark_drivers.csv"))
    given = parser.parse_args()
    for law in given.laws:
        if given.effects and not set(given.effects) & set(HIDDEN[law]):
            parser.error(f"--effects: {law} can hide {', '.join(HIDDEN[law])}")
    chosen = cases(
        given.seed,
        given.cases,
        given.spread / 100,
        given.laws,
        number=given.platoons,
        vehicles=given.vehicles,
        error=given.error,
        pairs=given.pairs,
        effects=given.effects,
        nature=given.nature,
        strength=given.push,
    )
    if given.work == "calibrate" or given.nothing:
        chosen = [case | {"effect": "none"} for case in chosen]
    tasks = [
        Task(
            f"{case['law']}-{case['effect']}-s{case['seed']}",
            evaluate,
            case | {"work": given.work},
        )
        for case in chosen
    ]
    run_cases(tasks, given.table, given.processes, ["law", "hidden"])


def run_cases(tasks: list[Task], table: Path, processes: int, by: list[str]) -> None:
    """Run the cases that are not done yet, write their rows, and print them with the counts of
    right and false answers.

    Args:
        table: the CSV file; results of single cases are kept in the folder of its name.
        by: columns for whose values the answers are counted.
    """
    results = run_tasks(
        tasks, table.with_suffix(""), workers=processes, fingerprint=sources(), title="cases"
    )
    rows = pd.DataFrame(list(results.values()))
    print(rows.to_string(index=False))
    write_text(table, str(rows.to_csv(index=False)))
    print(verdicts(rows, by).to_string(index=False))
    print(f"table: {table}")


if __name__ == "__main__":
    # worker processes import the functions by the name of this module
    from benchmarks import drivers

    drivers.main()
