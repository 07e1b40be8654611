"""Residuals of crowds, their derivatives, and the recovery of hidden effects."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor

import nnode
from benchmarks.people import LAW, TAU, WALLS, crowds
from nnode.app.python.inputs import model_options
from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Sequence
from nnode.diagnosis.crowds import simulated
from nnode.diagnosis.crowds.engine import PAIRS, SECONDS, CrowdEngine
from nnode.diagnosis.crowds.people import differing
from nnode.diagnosis.crowds.windows import Individuals, Windows
from nnode.diagnosis.curves import columns_of
from nnode.diagnosis.residuals.fit import evaluated, refine
from nnode.diagnosis.search import converged_fit
from nnode.diagnosis.statistics.bias import corrected_for_bias
from nnode.diagnosis.statistics.score import Screen, traces
from nnode.errors import SimulationError
from nnode.model import Crowd, build_model, make_law
from nnode.model.crowd_formula import norm
from nnode.model.effects import CATALOGUE, Effect, IndividualEffect, Probe, Setting, Strength
from nnode.model.effects.crowd import Alignment, Drift, PairRepulsion, heading
from nnode.model.extend import extended
from nnode.model.laws import PEDESTRIAN_LAWS, InteractionForce, Law
from nnode.model.term import Interval, State
from nnode.simulation import alone as simulate
from nnode.simulation.alone import PersonAlone
from studies.walking.tasks import without_walls
from tests.diagnosis import walkers
from tests.diagnosis.agreement import differences, distance, residuals
from tests.diagnosis.walkers import model

ROW = torch.tensor([walkers.A, 0.0, 0.0], dtype=torch.float64)


class CodedForce(InteractionForce):
    """The same force, evaluated as code."""

    def pair_force(self, dx: Tensor, dv: Tensor) -> Tensor:
        return super().pair_force(dx, dv)


class CodedLaw(Law):
    """The same law, evaluated as code."""

    def forward(self, state: State) -> Tensor:
        return super().forward(state)


class Stride(IndividualEffect):
    """The speed oscillates with every second step."""

    name = "stride"
    domain = "crowd"
    formula = "a sin(pi t + phase_i) along the heading"
    source = "this test"
    strengths: ClassVar = {"a": Strength(0.0, 0.1, Interval(0.0, 5.0), "1")}
    a: Tensor

    @classmethod
    def directions(cls, options: dict[str, Any]) -> list[tuple[dict[str, Any], float]]:
        return [({"a": 1.0}, 0.0), ({"a": 1.0}, math.pi / 2)]

    def forward(self, state: State) -> Tensor:
        phase, present = self.agent_numbers(state.scene, state.x)
        clock = (state.scene.start + state.t)[:, None]
        size = self.a * torch.sin(torch.pi * clock + phase) * present
        return size[..., None] * heading(state.velocity)


class Limit(Effect):
    """People decelerate above a speed."""

    name = "limit"
    domain = "crowd"
    formula = "-(|v| - v_max)+ e / s"
    source = "this test"
    strengths: ClassVar = {}
    settings: ClassVar = {"v_max": Setting(1.2, Interval(0.5, 3.0), "m/s")}
    v_max: Tensor

    def forward(self, state: State) -> Tensor:
        v = state.velocity
        return -(norm(v) - self.v_max).clamp(min=0)[..., None] * heading(v)


class WeakLimit(Limit):
    """A hundredth of it, for the linear response."""

    def forward(self, state: State) -> Tensor:
        return 0.01 * super().forward(state)


def paths(windows: Windows, system: Crowd, *, compiled: bool) -> Tensor:
    """``(F, 1, P, 4)`` states of the measured people."""
    rows = ParameterVector(system).row[None]
    rhs = PersonAlone(windows.around(system), system, ParameterVector(system).runs(rows))
    assert rhs.compiled is compiled
    start = torch.cat([windows.batch.x[0], windows.batch.v[0]], -1)
    return rhs.simulated(start, windows.steps)[:, :, *windows.person.T]


@pytest.fixture(scope="module")
def plain() -> list[Sequence]:
    return walkers.crowd()


@pytest.fixture(scope="module")
def engine(plain: list[Sequence]) -> CrowdEngine:
    engine = CrowdEngine(plain)
    engine.fit_whitening(model(), ROW)
    return engine


#: Standard deviation of logarithms of people's parameters, and of pushes, m/s².
SPREAD, PUSH = 0.15, 0.1


def with_speeds() -> Crowd:
    """The law of :func:`people_who_differ`."""
    return Crowd([make_law("esf", tau=TAU, **LAW)], desired="exit").double()


def people_who_differ(seed: int, turn: float = 0.0) -> list[Sequence]:
    """People with desired velocities and relaxation times of their own, whom pushes of 4 s
    disturb."""
    table = crowds("none", seed, spread=SPREAD, push=PUSH, turn=turn, sequences=16)
    return [replace(s, walls=WALLS.to_numpy()) for s in nnode.sequences(table)]


CONTACT = {"k": 200.0, "kappa": 30.0, "r": 0.45}


@pytest.mark.parametrize(
    "build",
    [
        partial(model, **CONTACT),
        partial(model, **CONTACT, walls=False),
        partial(model, **CONTACT, opposing_wall_friction=True),
        partial(model, PairRepulsion(A_2=0.4, B_2=0.8)),
        partial(model, Alignment(c=0.5)),
    ],
)
def test_compiled_force(
    plain: list[Sequence], build: Callable[..., Crowd], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(simulate, "CACHED", 200)  # several chunks, the last one smaller
    windows = Windows(plain, SECONDS)
    compiled, coded = (
        paths(windows, build(force=force), compiled=force is InteractionForce)
        for force in (InteractionForce, CodedForce)
    )
    torch.testing.assert_close(compiled, coded, rtol=0, atol=1e-10)
    without = paths(windows, model(), compiled=True)
    assert float((compiled - without).square().mean().sqrt()) > 0.01


def test_compiled_law_with_walls(plain: list[Sequence]) -> None:
    windows, law = Windows(plain, SECONDS), PEDESTRIAN_LAWS["esf"]

    def law_paths(kind: type[Law], entry: Any) -> Tensor:
        system = Crowd([kind(entry, "esf")], desired="direction").double()
        return paths(windows, system, compiled=kind is Law)

    compiled = law_paths(Law, law)
    torch.testing.assert_close(compiled, law_paths(CodedLaw, law), rtol=0, atol=1e-10)
    assert float((compiled - law_paths(Law, without_walls(law))).abs().max()) > 0.01


def test_rows_are_independent(engine: CrowdEngine) -> None:
    system, _ = extended(model(), Alignment(c=0.2))
    rows = ParameterVector(system).row + torch.tensor([[0.0] * 4, [3.0, 10.0, 1.0, 0.2]])
    residual = engine.residuals(system, rows)
    for k in range(2):
        alone = engine.residuals(system, rows[k : k + 1])[0]
        torch.testing.assert_close(residual[k], alone, rtol=1e-9, atol=1e-9)


def test_people_have_factors_on_parameters(plain: list[Sequence]) -> None:
    people, law = Windows(plain, SECONDS), with_speeds()
    rows, speed = ParameterVector(law).row[None], np.full(len(people.person), 1.3)

    def of_people(system: Crowd, factor: np.ndarray) -> Tensor:
        individuals = Individuals(speed, np.zeros(len(speed)), {"terms.0.tau": factor})
        around = people.around(system, individuals)
        rhs = PersonAlone(around, system, ParameterVector(system).runs(rows.repeat(2, 1)))
        start = torch.cat([people.batch.x[0], people.batch.v[0]], -1)
        return rhs.simulated(start, people.steps)[:, 1, *people.person.T]

    factor = np.where(np.arange(len(speed)) % 2, 2.0, 1.0)
    typical, slow = (of_people(law, np.full(len(speed), each)) for each in (1.0, 2.0))
    expected = torch.where(torch.from_numpy(factor == 2.0)[:, None], slow, typical)
    torch.testing.assert_close(of_people(law, factor), expected, rtol=0, atol=1e-12)
    rows[0, ParameterVector(law).names.index("terms.0.tau")] = 2 * TAU
    torch.testing.assert_close(of_people(law, np.ones(len(speed))), slow, rtol=0, atol=1e-12)


def test_residuals_of_true_model_are_white() -> None:
    engine = CrowdEngine(people_who_differ(1))
    engine.fit_whitening(with_speeds(), ParameterVector(with_speeds()).row)
    residual = residuals(engine, with_speeds()).numpy()
    assert len(residual) == len(engine.sequence) == len(engine.cluster) == len(engine.unit)
    by_sample = residual.reshape(len(engine.windows.person), -1)
    # the residuals of a person's start in a sequence are small, because pushes are unknown there
    later = by_sample[engine.windows.number[engine.windows.person[:, 0]] > 0]
    # the smoothed start depends on the first sample, whose residual is small, too
    later = later[:, 2:]
    np.testing.assert_allclose((later**2).mean(0), 1.0, atol=0.45)
    assert (later**2).mean() == pytest.approx(1.0, abs=0.1)
    following = (later[:, 2:] * later[:, :-2]).mean()
    assert abs(following) < 0.1


def test_differences_between_people_and_pushes_are_estimated() -> None:
    engine, system = CrowdEngine(people_who_differ(2)), with_speeds()
    engine.fit_whitening(system, ParameterVector(system).row)
    population = engine.population
    assert population is not None
    push, time, error = population.variances.noise
    assert population.random == ["desired_speed", "terms.0.tau"]
    assert population.variances.spread == pytest.approx([SPREAD, SPREAD], rel=0.35)
    assert push == pytest.approx(PUSH, rel=0.25)
    assert time == pytest.approx(4.0, rel=0.25)
    assert error == pytest.approx(0.005, rel=0.1)
    assert np.log(population.people.speed).std() == pytest.approx(SPREAD, rel=0.25)
    assert np.median(population.people.speed) == pytest.approx(1.3, rel=0.05)
    # pushes that last longer than a third of the record have no intervals
    rows = engine.variations()
    assert [rows[name]["at_bound"] for name in ("push", "push_time")] == ["", "high"]
    assert np.isnan([rows[name]["lower"] for name in ("push", "push_time")]).all()
    assert rows["tau"]["lower"] < 100 * SPREAD < rows["tau"]["upper"]


def test_directions_that_differ_are_estimated() -> None:
    engine = CrowdEngine(people_who_differ(2, turn=0.2))
    system = build_model({**model_options("esf"), "desired": "direction"}).double()
    ParameterVector(system).fill_(ParameterVector(with_speeds()).row.numpy())
    assert differing(system) == ["desired_speed", "desired_direction", "terms.0.tau"]
    engine.fit_whitening(system, ParameterVector(system).row)
    rows = engine.variations()
    direction = rows["desired_direction"]
    assert direction["unit"] == "rad"
    # the direction of a stream is the mean of four people
    assert direction["estimate"] == pytest.approx(0.2 * np.sqrt(3 / 4), rel=0.2)
    assert rows["desired_speed"]["estimate"] == pytest.approx(100 * SPREAD, rel=0.35)
    assert engine.population is not None
    for crowd in engine.simulated_engines(system, ParameterVector(system).row, 0):
        assert crowd.population is not None
        turns = engine.population.people.turn, crowd.population.people.turn
        assert np.corrcoef(*turns)[0, 1] > 0.8


def test_estimate_of_people_converges_where_windows_are_left_out() -> None:
    """Estimates jumped by 1,000 between linearisations that left out different windows. (In other
    tables they still change by up to 110, where a window whose weight is close to a half continues
    or not.)"""
    engine = CrowdEngine(people_who_differ(8)[:8], window=2.0)
    strong = build_model({**model_options("sf"), "desired": "exit"}).double()
    ParameterVector(strong).fill_(np.array([20.0, 0.0, 30.0]))
    first = engine._people.estimated(strong)
    assert not first.data.observed.all()
    again = engine._people.estimated(strong, first)
    assert again.criterion == pytest.approx(first.criterion, abs=20)


def errors(engine: CrowdEngine) -> np.ndarray:
    """Measured minus simulated positions, m."""
    return engine._people.differences(engine._states(model(), ROW[None])).position


def test_small_errors_of_a_start_hardly_change_residuals(engine: CrowdEngine) -> None:
    """Errors of the smoothed states at starts of records have a variance of their own; those at
    starts of later windows are added by one window and removed by the next one."""
    before = residuals(engine, model())
    raw_before, batch = errors(engine), engine.windows.batch
    measured = batch.x.clone(), batch.v.clone()
    try:
        for time in (0, -1):
            batch.x[time] += torch.tensor([0.01, -0.02])
            batch.v[time] += torch.tensor([0.02, 0.01])
        after = residuals(engine, model())
        raw_after = errors(engine)
    finally:
        batch.x, batch.v = measured
    change = float((after - before).square().mean().sqrt())
    unweighted = np.sqrt(np.mean((raw_before - raw_after) ** 2)) / engine._people.error
    assert np.abs(raw_before - raw_after).max() > 0.02
    assert change < 0.1 * unweighted


@pytest.mark.parametrize(("a_x", "relevant"), [(0.001, False), (0.05, True)])
def test_relevance_of_effect_depends_on_change_of_paths(
    engine: CrowdEngine, a_x: float, relevant: bool
) -> None:
    """People who drift are displaced by a_x t²/2 at most; positions have errors of 5 mm."""
    changed, _ = extended(model(), Drift(a_x=a_x, a_y=0.0))
    assert engine.relevant(model(), changed, 1.0) is relevant


@pytest.mark.thorough
def test_likelier_start_is_taken() -> None:
    engine, system = CrowdEngine(people_who_differ(4)[:5]), with_speeds()
    distant = copy.deepcopy(system)
    ParameterVector(distant).fill_(np.array([0.0, 3.0, 0.5, 1.0, 1.5]))
    first = [engine._first(start) for start in (distant, system)]
    assert first[0].criterion < first[1].criterion
    expected = engine._converged(first[1]).criterion
    assert engine._likeliest(distant, system).criterion == expected > first[1].criterion


def test_person_who_jumps_has_small_weight(plain: list[Sequence]) -> None:
    x = plain[0].x.copy()
    x[20:, 3] += 0.6
    engine = CrowdEngine([replace(plain[0], x=x), *plain[1:]])
    engine.fit_whitening(model(), ROW)
    weight = engine._fitted(model(), ROW).data.weight
    assert weight is not None
    weight = engine._people.parted(weight)[:, 0]
    window, person = engine.windows.person.T
    jumping = (engine.windows.sequence[window] == 0) & (person == 3)
    assert weight[jumping].min() < 0.1
    assert np.median(weight) > 0.8


@pytest.mark.thorough
def test_bias_is_that_of_calibrations_to_simulated_crowds() -> None:
    engine, system = CrowdEngine(people_who_differ(3)), with_speeds()
    fit = converged_fit(engine, system, rounds=1)
    row = torch.from_numpy(fit.row)
    bias = engine.biases(fit.system, row, 0).mean(0)
    shifts = [
        refine(simulated, copy.deepcopy(fit.system)).row - fit.row
        for seed in range(PAIRS)
        for simulated in engine.simulated_engines(fit.system, row, seed)
    ]
    error = fit.errors(engine.cluster)
    a = fit.names.index("terms.0.A")
    assert bias[a] < -0.5 * error[a]
    assert (np.abs(bias - np.mean(shifts, 0)) < 0.3 * error).all()
    corrected = corrected_for_bias(engine, fit, 0)
    np.testing.assert_allclose(corrected.row, fit.row - bias)
    assert (corrected.errors(engine.cluster) >= error).all()
    assert np.array_equal(engine.biases(fit.system, row, 0).mean(0), bias)
    assert not np.array_equal(engine.biases(fit.system, row, 7).mean(0), bias)


def test_simulation_that_diverges_is_refused(
    engine: CrowdEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    def diverges(*arguments: Any) -> list[np.ndarray]:
        return [np.full_like(s.x, np.nan) for s in engine.sequences]

    monkeypatch.setattr(simulated, "_simulated", diverges)
    with pytest.raises(SimulationError, match="diverges"):
        engine.simulated_engines(model(), ROW, 0)
    fit = evaluated(engine, model())
    assert corrected_for_bias(engine, fit, 0) is fit


def test_residuals_of_diverging_run_are_large_and_finite(engine: CrowdEngine) -> None:
    residual = engine.residuals(model(), torch.tensor([[1e9, 0.0, 0.0], ROW.tolist()]))
    assert bool(torch.isfinite(residual).all())
    assert float(residual[0].square().sum()) > 1e3 * float(residual[1].square().sum())


def test_tangents_are_finite_differences(plain: list[Sequence]) -> None:
    system, _ = extended(model(), PairRepulsion(A_2=0.2, B_2=0.8))
    row = ParameterVector(system).row
    row[1] = 50.0
    engine = CrowdEngine(plain, 1.5)  # at contacts, the linear response is less exact with time
    engine.fit_whitening(system, row)
    expected = differences(engine, system, row, torch.tensor([0.1, 1.0, 0.5, 0.02, 0.02]))
    for tangent, difference in zip(engine.tangents(system, row), expected, strict=True):
        if difference.any():
            assert distance(tangent, difference) < 0.1


@pytest.mark.parametrize("name", ["drift", "field_of_view", "wall_repulsion", "side_preference"])
def test_effect_columns_are_finite_differences(engine: CrowdEngine, name: str) -> None:
    effect = CATALOGUE.effects[name]
    probe = effect.probes(engine.batch, model())[0]
    columns = engine.screen_columns(model(), ROW, effect, probe)
    for column, (strength, step) in zip(columns, probe.steps.items(), strict=True):
        options = {**probe.options, strength: effect.strengths[strength].neutral + step}
        system, _ = extended(model(), effect(**options))
        change = residuals(engine, system) - residuals(engine, model())
        assert distance(column, change / step) < 0.02


def test_individual_columns_are_finite_differences(engine: CrowdEngine) -> None:
    effect = CATALOGUE.effects["walker_heterogeneity"]
    column = engine.individual(model(), ROW, effect, {})[0]
    draw = np.random.default_rng(3)
    eta = draw.normal(0, 0.05, len(engine.people))
    people = {name: [0.0] * 6 for name in engine.names}
    for value, ((b, i),) in zip(eta, engine.people, strict=True):
        people[engine.names[b]][i] = float(value)
    system, _ = extended(model(), effect(people=people))
    change = engine.residuals(system, ROW[None])[0] - residuals(engine, model())
    assert distance(change, torch.from_numpy(eta[engine.unit]) * column) < 0.1


def test_phase_columns_are_finite_differences(engine: CrowdEngine) -> None:
    sine, cosine = engine.individual(model(), ROW, Stride, {})
    people = dict.fromkeys(engine.names, [math.atan2(0.4, 0.3)] * 6)
    system, _ = extended(model(), Stride(people=people, a=0.05))
    change = residuals(engine, system) - residuals(engine, model())
    assert distance(change, 0.05 * (0.6 * sine + 0.8 * cosine)) < 0.05


def test_trace_of_effect_without_strengths(engine: CrowdEngine) -> None:
    assert Limit.probes(engine.batch, model()) == [Probe({}, {})]
    (trace,) = traces(engine, evaluated(engine, model()), Limit)
    change = residuals(engine, model(WeakLimit())) - residuals(engine, model())
    assert trace.columns.shape == (len(change), 1)
    assert distance(torch.from_numpy(trace.columns[:, 0]), change / 0.01) < 0.02


def test_flat_curve_is_a_drift(engine: CrowdEngine) -> None:
    fit = refine(engine, model())
    variables = {(variable.name, variable.level): variable for variable in engine.variables()}
    probe = Drift.probes(engine.batch, model())[0]
    drift = engine.screen_columns(fit.system, torch.from_numpy(fit.row), Drift, probe)[0].numpy()
    for name in ("position x", "position y", "clock time"):
        columns = columns_of(engine, fit, variables[name, "along x"])
        np.testing.assert_allclose(columns.sum(1), drift, rtol=1e-6, atol=1e-9)
    assert ("distance to the nearest wall", "away from it") in variables


def push(x: np.ndarray, v: np.ndarray, t: float) -> np.ndarray:
    dx = x[:, :, None] - x[:, None]
    d = walkers.length(dx)
    size = 0.35 * np.exp((2 * walkers.R - d) / 0.8) * (1 - np.eye(x.shape[1])) / d
    return (size[..., None] * dx).sum(2)


def walls(x: np.ndarray, v: np.ndarray, t: float) -> np.ndarray:
    low = 0.8 * np.exp((walkers.R - x[..., 1]) / 0.5)
    high = 0.8 * np.exp((walkers.R - (walkers.WIDTH - x[..., 1])) / 0.5)
    return np.stack([0 * low, low - high], -1)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("extra", "name", "true"),
    [
        (push, "pair_repulsion", {"A_2": 0.35, "B_2": 0.8}),
        (walkers.wind(0.1, -0.15), "drift", {"a_x": 0.1, "a_y": -0.15}),
        (walls, "wall_repulsion", {"A_w": 0.8, "B_w": 0.5}),
    ],
)
def test_hidden_effect_is_recovered(
    extra: walkers.Extra, name: str, true: dict[str, float]
) -> None:
    engine = CrowdEngine(walkers.crowd(extra, seed=4, sequences=16, noise=0.002))
    engine.fit_whitening(model(), ROW)
    fit = converged_fit(engine, model(), rounds=1)
    screen = Screen(fit, engine.cluster)
    effects = [
        effect
        for effect in CATALOGUE.of("crowd")
        if not issubclass(effect, IndividualEffect) and effect.confusable_group != "place"
    ]
    scores = screen.scores([t for effect in effects for t in traces(engine, fit, effect)])
    assert scores[0].effect.name == name
    system, place = extended(fit.system, scores[0].effect(**scores[0].options))
    population = engine.population_of(system)
    engine.set_population(population)  # the effect was attributed to pushes
    extended_fit = refine(engine, population.system)
    for key, value in true.items():
        estimate = extended_fit.row[extended_fit.names.index(f"terms.{place}.{key}")]
        assert estimate == pytest.approx(value, rel=0.1, abs=0.01)
    assert scores[0].p_value < 0.01


def test_what_differs_between_people() -> None:
    assert differing(with_speeds()) == ["desired_speed", "terms.0.tau"]
    assert differing(model()) == []  # desired speeds and tau are not part of this law
    drift, _ = extended(with_speeds(), Drift(a_x=0.1, a_y=0.1))
    assert differing(drift) == ["desired_speed", "terms.0.tau"]
    unbounded = with_speeds()
    unbounded.term_list[0].bounds.pop("tau")
    assert differing(unbounded) == ["desired_speed"]
