"""The residuals of crowds, their derivatives, and what they tell of hidden effects."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor

from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Sequence
from nnode.diagnosis.crowds.engine import CrowdEngine
from nnode.diagnosis.crowds.windows import Windows
from nnode.diagnosis.curves import columns_of
from nnode.diagnosis.residuals.fit import evaluated, refine
from nnode.diagnosis.statistics.score import Screen, traces
from nnode.model import Crowd
from nnode.model.crowd_formula import norm
from nnode.model.effects import CATALOGUE, Effect, IndividualEffect, Probe, Setting, Strength
from nnode.model.effects.crowd import Alignment, Drift, GaitSway, PairRepulsion, heading
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


class Same(InteractionForce):
    """A force that is the same, but code of its own."""

    def pair_force(self, dx: Tensor, dv: Tensor) -> Tensor:
        return super().pair_force(dx, dv)


class Coded(Law):
    """A formula that is evaluated as code."""

    def forward(self, state: State) -> Tensor:
        return super().forward(state)


class Stride(IndividualEffect):
    """People speed up and slow down as they step."""

    name = "stride"
    domain = "crowd"
    formula = "a sin(2 pi t + phase_i) along the way"
    source = "this test"
    strengths: ClassVar = {"a": Strength(0.0, 0.1, Interval(0.0, 5.0), "1")}
    a: Tensor

    @classmethod
    def directions(cls, options: dict[str, Any]) -> list[tuple[dict[str, Any], float]]:
        return [({"a": 1.0}, 0.0), ({"a": 1.0}, math.pi / 2)]

    def forward(self, state: State) -> Tensor:
        phase, there = self.agent_numbers(state.scene, state.x)
        clock = (state.scene.start + state.t)[:, None]
        size = self.a * torch.sin(2 * torch.pi * clock + phase) * there
        return size[..., None] * heading(state.velocity)


class Limit(Effect):
    """Nobody likes to walk faster than this."""

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


class Faint(Limit):
    """A hundredth of it: as weak as linear response asks for."""

    def forward(self, state: State) -> Tensor:
        return 0.01 * super().forward(state)


def paths(windows: Windows, system: Crowd, *, compiled: bool) -> Tensor:
    """``(F, 1, P, 4)`` of the real people."""
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
    found = CrowdEngine(plain)
    found.fit_whitening(model(), ROW)
    return found


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
def test_compiled_paths_are_those_of_a_law_that_is_code(
    plain: list[Sequence], build: Callable[..., Crowd], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(simulate, "CACHED", 200)  # several parts, the last one smaller
    windows = Windows(plain)
    compiled, coded = (
        paths(windows, build(force=force), compiled=force is InteractionForce)
        for force in (InteractionForce, Same)
    )
    torch.testing.assert_close(compiled, coded, rtol=0, atol=1e-10)
    bare = paths(windows, model(), compiled=True)
    assert float((compiled - bare).square().mean().sqrt()) > 0.01


def test_walls_of_a_law_are_felt(plain: list[Sequence]) -> None:
    windows = Windows(plain)
    found = []
    for law in (PEDESTRIAN_LAWS["esf"], without_walls(PEDESTRIAN_LAWS["esf"])):
        for kind in (Law, Coded):
            system = Crowd([kind(law, "esf")], desired="direction").double()
            found.append(paths(windows, system, compiled=kind is Law))
    torch.testing.assert_close(found[0], found[1], rtol=0, atol=1e-10)
    assert float((found[0] - found[2]).abs().max()) > 0.01


def test_rows_are_independent_of_each_other(engine: CrowdEngine) -> None:
    system, _ = extended(model(), Alignment(c=0.2))
    rows = ParameterVector(system).row + torch.tensor([[0.0] * 4, [3.0, 10.0, 1.0, 0.2]])
    together = engine.residuals(system, rows)
    for k in range(2):
        alone = engine.residuals(system, rows[k : k + 1])[0]
        torch.testing.assert_close(together[k], alone, rtol=1e-9, atol=1e-9)


def test_the_true_model_leaves_white_noise(engine: CrowdEngine) -> None:
    residual = residuals(engine, model()).numpy()
    assert len(residual) == len(engine.sequence) == len(engine.cluster) == len(engine.unit)
    each = residual.reshape(len(engine.windows.person), -1)
    np.testing.assert_allclose((each**2).mean(0), 1.0, atol=0.35)
    squares = engine.squares(model(), ROW)
    assert squares.value.mean() == pytest.approx(engine.noise_floor(), rel=0.1)


def test_a_wrong_start_does_not_show(engine: CrowdEngine) -> None:
    before = residuals(engine, model())
    kept = engine.windows.batch.x[0].clone(), engine.windows.batch.v[0].clone()
    try:
        engine.windows.batch.x[0] += torch.tensor([0.01, -0.02])
        engine.windows.batch.v[0] += torch.tensor([0.02, 0.01])
        after = residuals(engine, model())
        raw = engine._differences(model(), ROW[None])
    finally:
        engine.windows.batch.x[0], engine.windows.batch.v[0] = kept
    change = (after - before).square().mean().sqrt()
    scale = engine._differences(model(), ROW[None]) - raw
    assert float(scale.abs().max()) > 0.02
    assert float(change) < 0.1 * float(before.square().mean().sqrt())


def test_somebody_who_jumps_counts_little(plain: list[Sequence]) -> None:
    x = plain[0].x.copy()
    x[20:, 3] += 0.6
    found = CrowdEngine([replace(plain[0], x=x), *plain[1:]])
    found.fit_whitening(model(), ROW)
    weight = found._fitted_whitening(model(), ROW).weight
    place = {(int(w), int(i)): k for k, (w, i) in enumerate(found.windows.person)}
    assert weight[place[1, 3]] < 0.1
    assert np.median(weight) > 0.8


def test_a_run_that_flies_apart_is_bad_and_finite(engine: CrowdEngine) -> None:
    wild = engine.residuals(model(), torch.tensor([[1e9, 0.0, 0.0], ROW.tolist()]))
    assert bool(torch.isfinite(wild).all())
    assert float(wild[0].square().sum()) > 1e3 * float(wild[1].square().sum())


def test_tangents_are_those_of_simulations(plain: list[Sequence]) -> None:
    system, _ = extended(model(), PairRepulsion(A_2=0.2, B_2=0.8))
    row = ParameterVector(system).row
    row[1] = 50.0
    engine = CrowdEngine(plain)
    engine.fit_whitening(system, row)
    expected = differences(engine, system, row, torch.tensor([0.1, 1.0, 0.5, 0.02, 0.02]))
    for tangent, difference in zip(engine.tangents(system, row), expected, strict=True):
        if difference.any():
            assert distance(tangent, difference) < 0.1


@pytest.mark.parametrize("name", ["drift", "field_of_view", "wall_repulsion", "side_preference"])
def test_traces_are_those_of_simulations(engine: CrowdEngine, name: str) -> None:
    effect = CATALOGUE.effects[name]
    probe = effect.probes(engine.batch, model())[0]
    columns = engine.screen_columns(model(), ROW, effect, probe)
    for column, (strength, step) in zip(columns, probe.steps.items(), strict=True):
        options = {**probe.options, strength: effect.strengths[strength].neutral + step}
        system, _ = extended(model(), effect(**options))
        change = residuals(engine, system) - residuals(engine, model())
        assert distance(column, change / step) < 0.02


def test_numbers_of_each_person(engine: CrowdEngine) -> None:
    """What everyone's own eta changes is his share of the common column."""
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


@pytest.mark.parametrize(("effect", "options"), [(GaitSway, {"f": 0.9}), (Stride, {})])
def test_sine_and_cosine_of_steps(
    engine: CrowdEngine, effect: type[IndividualEffect], options: dict[str, float]
) -> None:
    sine, cosine = engine.individual(model(), ROW, effect, options)
    people = dict.fromkeys(engine.names, [GaitSway.person(np.array([0.3, 0.4]), {})] * 6)
    system, _ = extended(model(), effect(people=people, a=0.05, **options))
    change = residuals(engine, system) - residuals(engine, model())
    assert distance(change, 0.05 * (0.6 * sine + 0.8 * cosine)) < 0.05


def test_an_effect_without_strengths_has_a_trace(engine: CrowdEngine) -> None:
    assert Limit.probes(engine.batch, model()) == [Probe({}, {})]
    (trace,) = traces(engine, evaluated(engine, model()), Limit)
    change = residuals(engine, model(Faint())) - residuals(engine, model())
    assert trace.columns.shape == (len(change), 1)
    assert distance(torch.from_numpy(trace.columns[:, 0]), change / 0.01) < 0.02


def test_a_flat_curve_is_a_drift(engine: CrowdEngine) -> None:
    fit = refine(engine, model())
    found = {(one.name, one.level): one for one in engine.variables()}
    probe = Drift.probes(engine.batch, model())[0]
    drift = engine.screen_columns(fit.system, torch.from_numpy(fit.row), Drift, probe)[0].numpy()
    for name in ("position x", "position y", "clock time"):
        columns = columns_of(engine, fit, found[name, "along x"])
        np.testing.assert_allclose(columns.sum(1), drift, rtol=1e-6, atol=1e-9)
    assert ("distance to the nearest wall", "away from it") in found


def push(x: np.ndarray, v: np.ndarray, t: float) -> np.ndarray:
    dx = x[:, :, None] - x[:, None]
    d = walkers.length(dx)
    size = 0.35 * np.exp((2 * walkers.R - d) / 0.8) * (1 - np.eye(x.shape[1])) / d
    return (size[..., None] * dx).sum(2)


def walls(x: np.ndarray, v: np.ndarray, t: float) -> np.ndarray:
    low = 0.8 * np.exp((walkers.R - x[..., 1]) / 0.5)
    high = 0.8 * np.exp((walkers.R - (walkers.WIDTH - x[..., 1])) / 0.5)
    return np.stack([0 * low, low - high], -1)


@pytest.mark.parametrize(
    ("extra", "name", "true"),
    [
        (push, "pair_repulsion", {"A_2": 0.35, "B_2": 0.8}),
        (walkers.wind(0.1, -0.15), "drift", {"a_x": 0.1, "a_y": -0.15}),
        (walls, "wall_repulsion", {"A_w": 0.8, "B_w": 0.5}),
    ],
)
def test_a_hidden_effect_scores_best_and_is_measured(
    extra: walkers.Extra, name: str, true: dict[str, float]
) -> None:
    engine = CrowdEngine(walkers.crowd(extra, seed=4, sequences=12, noise=0.002))
    start = model()
    engine.fit_whitening(start, ROW)
    fit = refine(engine, start)
    engine.fit_whitening(fit.system, ParameterVector(fit.system).row)
    fit = refine(engine, fit.system)
    screen = Screen(fit, engine.cluster)
    effects = [
        e
        for e in CATALOGUE.of("crowd")
        if not issubclass(e, IndividualEffect) and e.confusable_group != "place"
    ]
    scores = screen.scores([t for e in effects for t in traces(engine, fit, e)])
    assert scores[0].effect.name == name
    system, place = extended(fit.system, scores[0].effect(**scores[0].options))
    better = refine(engine, system)
    for key, value in true.items():
        found = better.row[better.names.index(f"terms.{place}.{key}")]
        assert found == pytest.approx(value, rel=0.1, abs=0.01)
    assert fit.cost - better.cost > 100
