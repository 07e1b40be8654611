"""Residuals of platoons, their derivatives, and the recovery of hidden effects."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from nnode.app.python.inputs import model_options
from nnode.calibrate.parameters import ParameterVector
from nnode.data.clusters import group_sums
from nnode.data.paths import noise_variance, smooth, velocity
from nnode.data.sequence import Sequence, collate
from nnode.diagnosis.curves import curves, significant_curves
from nnode.diagnosis.lanes.engine import FORGET, LARGE, TrafficEngine, huber_residuals
from nnode.diagnosis.residuals.fit import Fit, refine
from nnode.diagnosis.residuals.variables import Curve, Variable
from nnode.diagnosis.search import converged_fit, search
from nnode.diagnosis.statistics.paired import heldout
from nnode.model import System
from nnode.model.arrays import Formulas
from nnode.model.build import add_effects, build_model
from nnode.model.effects import CATALOGUE, Effect, IndividualEffect
from nnode.model.effects.lane import DriverHeterogeneity, RelativeSpeed, SpeedZone
from nnode.model.extend import extended
from nnode.model.parse import parse
from nnode.simulation import TorchdiffeqSolver, rhs
from tests.diagnosis.agreement import differences, distance, residuals
from tests.diagnosis.platoons import LENGTH, V0, delayed, lin, platoons, relative_speed
from tests.model.test_tensors import FORMULAS

ROW = ParameterVector(lin()).row
LAWS: dict[str, dict[str, Any]] = {
    "lin": {"term": "lin", "name": "lin", "v0": V0, "L": LENGTH, "L_min": 1.0},
    "log": {"term": "log", "name": "log", "v0": 18.0, "L": LENGTH, "L_min": 1.0},
    "n4": {"term": "network_speed", "name": "n4", "hidden": 4, "v0": 20.0, "box": None},
}
EFFECTS: dict[str, dict[str, Any]] = {
    "relative_speed": {"kappa": 0.2},
    "time_gap": {"h": 0.1},
    "multi_anticipation": {"c": 0.2},
    "reaction_delay": {"T": 0.5},
    "inertia": {"tau_v": 0.6},
    "memory": {"tau_m": 8.0},
    "speed_zone": {"alpha": 0.8, "a": 300.0, "b": 400.0},
    "speed_period": {"alpha": 0.8, "a": 104.0, "b": 110.0},
    "free_flow_speed": {"v_max": 18.0},
    "asymmetric_response": {"kappa_open": 0.2, "kappa_close": 0.3},
    "leader_speed": {"weight": 0.3},
    "leader_length": {"beta": 0.4},
    "driver_heterogeneity": {
        "sigma": 0.1,
        "people": {f"r/{s}": [0.1, -0.1, 0.05, 0.0, 0.0] for s in range(3)},
    },
    "vehicle_class": {"phi": 0.9},
}


def model(law: str, *effects: str, leader: str = "measured") -> System:
    options = LAWS.get(law) or model_options(law, leader)
    system = build_model({**options, "leader": leader}, 0).double()
    add_effects(system, [{"name": name, **EFFECTS[name]} for name in effects])
    return system


def shortened(sequences: list[Sequence]) -> list[Sequence]:
    """Platoons of 5, 3 and 2 vehicles: padding and missing second vehicles are a case."""
    return [s.select(np.arange(5) < n) for s, n in zip(sequences, (5, 3, 2), strict=True)]


@pytest.fixture(scope="module")
def plain() -> list[Sequence]:
    return platoons(driver=0.2)


@pytest.fixture(scope="module")
def reacting() -> list[Sequence]:
    return platoons(relative_speed(0.4), driver=0.2)


@pytest.fixture(scope="module")
def noiseless() -> list[Sequence]:
    return shortened([replace(s, length=np.full(5, 4.5)) for s in platoons(number=3, noise=0.0)])


@pytest.fixture(scope="module")
def mixed() -> list[Sequence]:
    """Platoons of vehicles of several lengths and classes."""
    rng = np.random.default_rng(0)
    sequences = platoons(relative_speed(0.2), number=3, driver=0.2, seconds=8.0)
    kind = ("truck", *["car"] * 4)
    return shortened([replace(s, length=rng.uniform(4, 9, 5), kind=kind) for s in sequences])


def test_noise_is_estimated_and_smoothed() -> None:
    t = 0.2 * np.arange(120)[:, None]
    true = 15 * t + 3 * np.sin(0.4 * t + np.arange(4))
    noisy = true + np.random.default_rng(0).normal(0, 0.1, true.shape)
    assert noise_variance(noisy) == pytest.approx(0.01, rel=0.2)
    assert np.sqrt(((smooth(noisy) - true) ** 2).mean()) < 0.05
    speed = 15 + 1.2 * np.cos(0.4 * t + np.arange(4))
    assert np.abs(velocity(true, 0.2) - speed).max() < 0.02


def test_true_model_has_no_error_without_noise(plain: list[Sequence]) -> None:
    engine = TrafficEngine(platoons(noise=0.0))
    errors = engine.squares(lin(), ROW)
    assert np.sqrt(errors.means().max()) < 2e-3
    # the time after a start is not compared
    assert len(errors.value) == len(engine.sequence) < sum(s.x[1:, 1:].size for s in plain)


def test_windows_compare_each_sample_once() -> None:
    long = platoons(number=2, seconds=40.0)
    engine = TrafficEngine(long)
    whole = TrafficEngine(long, np.inf)
    assert len(engine.batch) > len(whole.batch) == 2
    # boundary samples belong to the window before; whole sequences are compared from their start
    samples, vehicles = long[0].x.shape[0], long[0].x.shape[1]
    forgotten = int(FORGET / long[0].dt + 1e-9)
    assert len(whole.sequence) == 2 * (samples - 1) * (vehicles - 1)
    assert len(engine.sequence) == 2 * (samples - 1 - forgotten) * (vehicles - 1)
    first, second = (set(engine.cluster[engine.sequence == s]) for s in range(2))
    assert first.isdisjoint(second)


def test_squares_of_residuals_are_huber_losses() -> None:
    r = torch.tensor([0.5, -LARGE, 10 * LARGE], dtype=torch.float64)
    residual = huber_residuals(r)
    assert residual[:2].tolist() == r[:2].tolist()
    assert float(residual[2] ** 2) == pytest.approx(2 * LARGE * 10 * LARGE - LARGE**2)


def test_delay_is_simulated_precisely() -> None:
    """The model's filter is compared with data of a true delay with its history."""
    engine = TrafficEngine(delayed(0.6))
    right = lin({"name": "reaction_delay", "T": 0.6})
    error = engine.squares(right, ParameterVector(right).row).means().mean()
    assert np.sqrt(error) < 0.03
    assert error < 0.05 * engine.squares(lin(), ROW).means().mean()


@pytest.mark.thorough
@pytest.mark.parametrize("data", ["reacting", "plain"])
def test_hidden_effect_is_recovered(data: str, request: pytest.FixtureRequest) -> None:
    engine = TrafficEngine(request.getfixturevalue(data))
    base = converged_fit(engine, lin())
    result = search(engine, base, CATALOGUE.of("traffic"))
    if data == "plain":
        assert not result.steps
        assert not significant_curves(engine, base, curves(engine, base, engine.variables()), 0.01)
        assert base.row == pytest.approx([V0, LENGTH], rel=0.05)
        return
    assert [step.chosen.name for step in result.steps] == ["relative_speed"]
    i = result.fit.names.index("terms.1.kappa")
    low, high = result.fit.intervals(engine.cluster)[i]
    assert result.fit.row[i] == pytest.approx(0.4, abs=0.05)
    assert low < 0.4 < high


def test_best_curve_has_the_variable_of_the_effect() -> None:
    def slow(x: np.ndarray, law: np.ndarray, lead: np.ndarray) -> np.ndarray:
        return law * np.where((x[:, :-1] > 250) & (x[:, :-1] < 330), 0.9, 1.0)

    engine = TrafficEngine(platoons(slow, driver=0.1))
    fit = converged_fit(engine, lin())
    best = curves(engine, fit, engine.variables())[0]
    assert best.variable.name == "position"
    assert best.gain.low > 0


def test_heldout_cost_is_that_of_a_refit(reacting: list[Sequence]) -> None:
    engine = TrafficEngine(reacting)
    fit = converged_fit(engine, lin())
    losses = heldout(fit, engine.cluster)
    first, others = TrafficEngine(reacting[:1]), TrafficEngine(reacting[1:])
    first.filter = others.filter = engine.filter
    refit = refine(others, lin(), tolerance=1e-8)
    residual = first.residuals(lin(), torch.from_numpy(refit.row)[None])[0]
    assert losses[0] == pytest.approx(float(residual @ residual), rel=0.02)


def test_heldout_cost_ignores_parameters_that_only_the_sequence_determines() -> None:
    rng = np.random.default_rng(0)
    sequence = np.repeat(np.arange(4), 50)
    jacobian = rng.normal(size=(200, 2))
    first, second = jacobian[sequence == 2].T
    jacobian[:, 1] *= 1e-7
    jacobian[sequence == 2, 1] = second - first * (first @ second) / (first @ first)
    residual = rng.normal(size=200)
    fit = Fit(System([]), ["a", "b"], np.zeros(2), residual, jacobian, np.ones(2, dtype=bool))
    losses = heldout(fit, sequence)
    assert losses[2] == pytest.approx(group_sums(residual**2, sequence)[2], rel=0.1)
    fit.jacobian, fit.free = jacobian[:, :1], np.ones(1, dtype=bool)
    np.testing.assert_allclose(losses, heldout(fit, sequence), rtol=1e-3)


def assert_equal(actual: Tensor, expected: Tensor, tolerance: float) -> None:
    """The largest difference is below a share of the largest value."""
    limit = tolerance * float(expected.abs().max())
    torch.testing.assert_close(actual, expected, rtol=0.0, atol=limit)


def assert_as_code(
    sequences: list[Sequence], compute: Callable[[TrafficEngine], Tensor], tolerance: float = 1e-9
) -> None:
    """Kernels of formulas compute the same as PyTorch code, term by term."""
    compiled = compute(TrafficEngine(sequences))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rhs, "formula_of", lambda *_: None)
        assert_equal(compiled, compute(TrafficEngine(sequences)), tolerance)


def rows_of(system: System) -> Tensor:
    row = ParameterVector(system).row
    return torch.stack([row, 1.01 * row, row + 0.01])


@pytest.mark.parametrize("text", FORMULAS)
def test_formula_of_arrays_and_tensors(text: str) -> None:
    rng, formulas = np.random.default_rng(3), Formulas([parse(text)])
    values = {name: rng.uniform(0.3, 2.0, 50) for name in "abc"}
    tensors = {name: torch.from_numpy(value) for name, value in values.items()}
    (array,), (tensor,) = formulas(values), formulas(tensors)
    assert_equal(torch.from_numpy(array), tensor, 1e-14)


@pytest.mark.parametrize(
    ("law", "leader", "effects"),
    [
        ("lin", "measured", ()),
        ("lin", "constant", ()),
        ("log", "measured", ("relative_speed",)),
        ("log", "constant", ("leader_speed", "relative_speed")),
        ("n4", "measured", ("speed_zone",)),
        ("n4", "constant", ("reaction_delay",)),
        ("lin", "measured", ("speed_period", "leader_length", "vehicle_class")),
        ("lin", "measured", ("driver_heterogeneity", "free_flow_speed", "multi_anticipation")),
        ("lin", "measured", ("reaction_delay", "time_gap", "inertia")),
        ("lin", "constant", ("multi_anticipation", "time_gap", "asymmetric_response")),
    ],
)
def test_compiled_runs_and_tangents(
    mixed: list[Sequence], law: str, leader: str, effects: tuple[str, ...]
) -> None:
    system = model(law, *effects, leader=leader)
    assert rhs.formula_of(system) is not None
    rows = rows_of(system)
    assert_as_code(mixed, lambda engine: engine.residuals(system, rows))
    assert_as_code(mixed, lambda engine: engine.tangents(system, rows[0]))


@pytest.mark.parametrize("leader", ["measured", "constant"])
@pytest.mark.parametrize("effects", [(), ("relative_speed",), ("inertia",)])
def test_compiled_effect_columns(
    mixed: list[Sequence], leader: str, effects: tuple[str, ...]
) -> None:
    system = model("lin", *effects, leader=leader)
    row = ParameterVector(system).row

    def columns(engine: TrafficEngine) -> Tensor:
        by_probe = [
            engine.screen_columns(system, row, effect, probe)
            for effect in CATALOGUE.of("traffic")
            if effect.name not in effects and not issubclass(effect, IndividualEffect)
            for probe in effect.probes(engine.batch, system)[:12]
        ]
        return torch.cat([c / c.abs().max().clamp(min=1e-9) for c in by_probe])

    assert_as_code(mixed, columns, 1e-8)  # of differences of rates


def test_compiled_individual_columns(mixed: list[Sequence]) -> None:
    system = model("lin", "relative_speed")
    row = ParameterVector(system).row
    assert_as_code(mixed, lambda e: e.individual(system, row, DriverHeterogeneity, {}), 1e-8)


def assert_curve_as_code(sequences: list[Sequence], leader: str, variable: Variable) -> None:
    system = model("lin", "relative_speed", leader=leader)
    row = ParameterVector(system).row

    def rates(state: Any) -> list[Tensor]:
        direction = variable.direction(state)
        return [w[..., None] * direction for w in variable.weights(state).unbind(-1)]

    assert_as_code(sequences, lambda engine: engine.response(system, row, rates))
    number = 2 if variable.lengths else len(variable.knots)
    bent = model("lin", "relative_speed", leader=leader)
    bent.terms.append(Curve(variable, np.random.default_rng(1).normal(0, 0.2, number)))
    rows = rows_of(bent)
    assert_as_code(sequences, lambda engine: engine.residuals(bent, rows))
    assert_as_code(sequences, lambda engine: engine.tangents(bent, rows[0]))


@pytest.mark.thorough
@pytest.mark.parametrize("leader", ["measured", "constant"])
def test_compiled_curves(mixed: list[Sequence], leader: str) -> None:
    for variable in TrafficEngine(mixed).variables():
        waves = len(variable.lengths)
        assert_curve_as_code(mixed, leader, variable.wave(waves // 2) if waves else variable)


def test_regression_start_keeps_model_with_memory(mixed: list[Sequence]) -> None:
    system = model("lin", "inertia")
    start = TrafficEngine(mixed).regression_start(system)
    assert ParameterVector(start).row.tolist() == ParameterVector(system).row.tolist()


def test_regression_start_lowers_cost() -> None:
    system = model("helly")
    engine = TrafficEngine(platoons(number=4, noise=0.01))
    start = engine.regression_start(system)
    before, after = (
        engine.squares(s, ParameterVector(s).row).means().mean() for s in (system, start)
    )
    assert after < before


@pytest.mark.thorough
@torch.no_grad()
@pytest.mark.parametrize(("law", "close"), [("idm", 2e-3), ("fvdm", 1e-3), ("gipps", 1e-2)])
def test_runs_match_smaller_steps(noiseless: list[Sequence], law: str, close: float) -> None:
    system, engine = model(law), TrafficEngine(noiseless, np.inf)
    run = engine.simulate(system, ParameterVector(system).row[None])[0][..., 0]
    batch = engine.smoothed
    smoothed = [
        replace(
            s,
            x=batch.x[: s.n_samples, i, : s.n_agents].numpy(),
            v=batch.v[: s.n_samples, i, : s.n_agents].numpy(),
        )
        for i, s in enumerate(engine.sequences)
    ]
    exact = TorchdiffeqSolver("rk4", dt=0.05)(system, collate(smoothed)).x[..., 0]
    error = torch.where(engine.follows, run - exact, 0.0)
    assert float(error.abs().max()) < close


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("law", "effects", "share"),
    [
        ("lin", [], 0.06),
        ("lin", ["relative_speed"], 0.06),
        ("lin", ["inertia"], 0.06),
        ("lin", ["reaction_delay"], 0.06),
        ("lin", ["time_gap"], 0.06),
        ("lin", ["multi_anticipation"], 0.06),
        ("idm", [], 0.01),
        ("idm", ["memory", "relative_speed"], 0.02),
        ("fvdm", [], 0.01),
        ("helly", [], 0.01),
        # the trapezoidal rule at the samples against Runge and Kutta's between them
        ("gipps", [], 0.06),
        ("krauss", [], 0.06),
    ],
)
def test_tangents_are_finite_differences(
    noiseless: list[Sequence], law: str, effects: list[str], share: float
) -> None:
    system = model(law, *effects)
    engine = TrafficEngine(platoons(number=4, driver=0.2) if law == "lin" else noiseless)
    row = ParameterVector(system).row
    expected = differences(engine, system, row, 1e-4 * row.abs().clamp(min=0.1))
    tangents, names = engine.tangents(system, row), ParameterVector(system).names
    for tangent, difference, name in zip(tangents, expected, names, strict=True):
        if float(difference.norm()) > 1e-2:  # else a bound of the formula holds everywhere
            assert distance(tangent, difference) < share, name
        else:
            assert float(tangent.norm()) < 2e-2, name


@pytest.mark.parametrize(
    ("law", "effect"), [("lin", RelativeSpeed), ("idm", RelativeSpeed), ("idm", SpeedZone)]
)
def test_effect_columns_are_finite_differences(
    noiseless: list[Sequence], law: str, effect: type[Effect]
) -> None:
    system, engine = model(law), TrafficEngine(noiseless)
    probes = effect.probes(engine.batch, system)
    probe = probes[len(probes) // 2]
    (column,) = engine.screen_columns(system, ParameterVector(system).row, effect, probe)
    ((name, step),) = probe.steps.items()
    value = effect.strengths[name].neutral + step
    changed, _ = extended(system, effect(**{**probe.options, name: value}))
    difference = (residuals(engine, changed) - residuals(engine, system)) / step
    # an effect of this size bends the paths along which its column is computed
    assert torch.nn.functional.cosine_similarity(column, difference, dim=0) > 0.99
    assert distance(column, difference) < 0.1


@pytest.mark.parametrize("name", ["gap", "speed difference"])
def test_tangents_with_curve_are_finite_differences(noiseless: list[Sequence], name: str) -> None:
    engine, system = TrafficEngine(noiseless), model("idm", "memory")
    variable = next(variable for variable in engine.variables() if variable.name == name)
    amounts = 0.1 * np.sin(np.linspace(0, np.pi, len(variable.knots)))
    system.terms.append(Curve(variable, amounts))
    row = ParameterVector(system).row
    tangents = engine.tangents(system, row)
    expected = differences(engine, system, row, 1e-4 * row.abs().clamp(min=0.1))
    for k, parameter in enumerate(ParameterVector(system).names):
        if "v0" not in parameter:  # these data hardly depend on v0
            assert distance(tangents[k], expected[k]) < 0.05
