"""The residuals of crowds, their derivatives, and what they tell of hidden effects."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Sequence
from nnode.discover.crowds.engine import CrowdEngine
from nnode.discover.crowds.windows import Windows
from nnode.discover.locate.curves import columns_of
from nnode.discover.residuals.fit import refine
from nnode.discover.statistics.score import Screen, traces
from nnode.model import Crowd, make_law
from nnode.model.effects import CATALOGUE, Effect, IndividualEffect
from nnode.model.effects.crowd import Alignment, Drift, PairRepulsion
from nnode.model.extend import extended
from nnode.model.laws import PEDESTRIAN_LAWS, InteractionForce, Law
from nnode.model.term import State
from nnode.simulation import alone as simulate
from nnode.simulation.alone import PersonAlone
from studies.walking.laws import without_walls
from tests.discover import walkers

ROW = torch.tensor([walkers.A, 0.0, 0.0], dtype=torch.float64)


class Same(InteractionForce):
    """A force that is the same, but code of its own."""

    def pair_force(self, dx: Tensor, dv: Tensor) -> Tensor:
        return super().pair_force(dx, dv)


class Coded(Law):
    """A formula that is evaluated as code."""

    def forward(self, state: State) -> Tensor:
        return super().forward(state)


def model(force: type[InteractionForce] = InteractionForce, **options: float | bool) -> Crowd:
    values: Any = {"A": walkers.A, "k": 0.0, "kappa": 0.0, "B": walkers.B, **options}
    law = force(entry="social_force", **values)
    return Crowd([make_law("relaxation", tau=walkers.TAU), law])


def paths(windows: Windows, system: Crowd, rows: Tensor | None = None, *, compiled: bool) -> Tensor:
    """``(F, R, P, 4)`` of the real people, by default with the model's own parameters."""
    rows = ParameterVector(system).row[None] if rows is None else rows
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


# -- simulation ------------------------------------------------------------------------------


@pytest.mark.parametrize("opposing", [False, True])
@pytest.mark.parametrize("walls", [False, True])
def test_compiled_paths_are_those_of_the_model(
    plain: list[Sequence], opposing: bool, walls: bool
) -> None:
    windows = Windows(plain)
    rows = torch.tensor([[15.0, 0.0, 0.0], [25.0, 200.0, 30.0]], dtype=torch.float64)
    found = []
    for force in (InteractionForce, Same):
        system = model(force, opposing_wall_friction=opposing, walls=walls, r=0.45)
        found.append(paths(windows, system, rows, compiled=force is not Same))
    torch.testing.assert_close(found[0], found[1], rtol=0, atol=1e-10)
    assert float((found[0][:, 0] - found[0][:, 1])[..., :2].abs().max()) > 0.05


def test_walls_of_a_law_are_felt(plain: list[Sequence]) -> None:
    windows = Windows(plain)
    found = []
    for law in (PEDESTRIAN_LAWS["esf"], without_walls(PEDESTRIAN_LAWS["esf"])):
        for kind in (Law, Coded):
            system = Crowd([kind(law, "esf")], desired="direction").double()
            found.append(paths(windows, system, compiled=kind is Law))
    torch.testing.assert_close(found[0], found[1], rtol=0, atol=1e-10)
    assert float((found[0] - found[2]).abs().max()) > 0.01


@pytest.mark.parametrize("effect", [PairRepulsion(A_2=0.4, B_2=0.8), Alignment(c=0.5)])
def test_effects_of_a_compiled_law_are_those_of_one_that_is_code(
    plain: list[Sequence], effect: Effect, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(simulate, "CACHED", 200)  # several parts, the last one smaller
    windows = Windows(plain)
    found = []
    for force in (InteractionForce, Same):
        system, _ = extended(model(force), effect)
        found.append(
            paths(
                windows,
                system,
                ParameterVector(system).row[None],
                compiled=force is InteractionForce,
            )
        )
    bare = paths(windows, model(), ROW[None], compiled=True)
    assert float((found[1] - bare).square().mean().sqrt()) > 0.02
    torch.testing.assert_close(found[0], found[1], rtol=0, atol=1e-10)


def test_rows_are_independent_of_each_other(engine: CrowdEngine) -> None:
    system, _ = extended(model(), Alignment(c=0.2))
    rows = ParameterVector(system).row + torch.tensor([[0.0] * 4, [3.0, 10.0, 1.0, 0.2]])
    together = engine.residuals(system, rows)
    for k in range(2):
        alone = engine.residuals(system, rows[k : k + 1])[0]
        torch.testing.assert_close(together[k], alone, rtol=1e-9, atol=1e-9)


# -- residuals -------------------------------------------------------------------------------


def test_the_true_model_leaves_white_noise(engine: CrowdEngine) -> None:
    residual = engine.residuals(model(), ROW[None])[0].numpy()
    assert len(residual) == len(engine.sequence) == len(engine.cluster) == len(engine.unit)
    each = residual.reshape(len(engine.windows.person), -1)
    np.testing.assert_allclose((each**2).mean(0), 1.0, atol=0.35)
    squares = engine.squares(model(), ROW)
    assert squares.value.mean() == pytest.approx(engine.noise_floor(), rel=0.1)


def test_a_wrong_start_does_not_show(engine: CrowdEngine) -> None:
    before = engine.residuals(model(), ROW[None])[0]
    kept = engine.windows.batch.x[0].clone(), engine.windows.batch.v[0].clone()
    try:
        engine.windows.batch.x[0] += torch.tensor([0.01, -0.02])
        engine.windows.batch.v[0] += torch.tensor([0.02, 0.01])
        after = engine.residuals(model(), ROW[None])[0]
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


# -- derivatives -----------------------------------------------------------------------------


def alike(a: torch.Tensor, b: torch.Tensor) -> tuple[float, float]:
    """Cosine of the angle, and ratio of the lengths."""
    return float(a @ b / a.norm() / b.norm()), float(a.norm() / b.norm())


def test_tangents_are_those_of_simulations(plain: list[Sequence]) -> None:
    system, _ = extended(model(), PairRepulsion(A_2=0.2, B_2=0.8))
    row = ParameterVector(system).row
    row[1] = 50.0
    engine = CrowdEngine(plain)
    engine.fit_whitening(system, row)
    found = engine.tangents(system, row)
    step = torch.tensor([0.1, 1.0, 0.5, 0.02, 0.02])
    for k in range(len(row)):
        change = torch.zeros_like(row)
        change[k] = step[k]
        both = engine.residuals(system, torch.stack([row + change, row - change]))
        expected = (both[0] - both[1]) / (2 * step[k])
        if float(expected.norm()) > 0:
            cosine, ratio = alike(found[k], expected)
            assert cosine > 0.97
            assert ratio == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("name", ["drift", "field_of_view", "wall_repulsion", "side_preference"])
def test_traces_are_those_of_simulations(engine: CrowdEngine, name: str) -> None:
    effect = CATALOGUE.effects[name]
    probe = effect.probes(engine.batch, model())[0]
    found = engine.screen_columns(model(), ROW, effect, probe)
    plain = engine.residuals(model(), ROW[None])[0]
    for column, (strength, step) in zip(found, probe.steps.items(), strict=True):
        options = {**probe.options, strength: effect.strengths[strength].neutral + step}
        system, _ = extended(model(), effect(**options))
        changed = engine.residuals(system, ParameterVector(system).row[None])[0]
        cosine, ratio = alike(column, (changed - plain) / step)
        assert cosine > 0.98
        assert ratio == pytest.approx(1.0, abs=0.05)


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
    change = engine.residuals(system, ROW[None])[0] - engine.residuals(model(), ROW[None])[0]
    expected = torch.from_numpy(eta[engine.unit]) * column
    cosine, ratio = alike(change, expected)
    assert cosine > 0.99
    assert ratio == pytest.approx(1.0, abs=0.05)


def test_sine_and_cosine_of_the_gait(engine: CrowdEngine) -> None:
    effect = CATALOGUE.effects["gait_sway"]
    sine, cosine = engine.individual(model(), ROW, effect, {"f": 0.9})
    phase = effect.person(np.array([0.3, 0.4]), {})  # type: ignore[attr-defined]
    people = {name: [phase] * 6 for name in engine.names}
    system, _ = extended(model(), effect(people=people, a=0.05, f=0.9))
    row = ParameterVector(system).row
    change = engine.residuals(system, row[None])[0] - engine.residuals(model(), ROW[None])[0]
    agreement, ratio = alike(change, 0.05 * (0.6 * sine + 0.8 * cosine))
    assert agreement > 0.97
    assert ratio == pytest.approx(1.0, abs=0.1)


def test_a_flat_curve_is_a_drift(engine: CrowdEngine) -> None:
    fit = refine(engine, model())
    found = {(one.name, one.level): one for one in engine.variables()}
    probe = Drift.probes(engine.batch, model())[0]
    drift = engine.screen_columns(fit.system, torch.from_numpy(fit.row), Drift, probe)[0].numpy()
    for name in ("position x", "position y", "clock time"):
        columns = columns_of(engine, fit, found[name, "along x"])
        np.testing.assert_allclose(columns.sum(1), drift, rtol=1e-6, atol=1e-9)
    assert ("distance to the nearest wall", "away from it") in found


# -- what it is for --------------------------------------------------------------------------


def push(x: np.ndarray, v: np.ndarray, t: float) -> np.ndarray:
    dx = x[:, :, None] - x[:, None]
    d = walkers.length(dx)
    size = 0.35 * np.exp((2 * walkers.R - d) / 0.8) * (1 - np.eye(x.shape[1])) / d
    return (size[..., None] * dx).sum(2)


def wind(x: np.ndarray, v: np.ndarray, t: float) -> np.ndarray:
    return np.broadcast_to(np.array([0.1, -0.15]), x.shape)


def walls(x: np.ndarray, v: np.ndarray, t: float) -> np.ndarray:
    low = 0.8 * np.exp((walkers.R - x[..., 1]) / 0.5)
    high = 0.8 * np.exp((walkers.R - (walkers.WIDTH - x[..., 1])) / 0.5)
    return np.stack([0 * low, low - high], -1)


@pytest.mark.parametrize(
    ("extra", "name", "true"),
    [
        (push, "pair_repulsion", {"A_2": 0.35, "B_2": 0.8}),
        (wind, "drift", {"a_x": 0.1, "a_y": -0.15}),
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
