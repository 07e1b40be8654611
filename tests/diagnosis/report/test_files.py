"""The report in plain types, and the extended model as options and checkpoint."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from nnode.calibrate.optimizers import AdadeltaOptions
from nnode.calibrate.options import TrainerOptions
from nnode.diagnosis.report.files import (
    SCHEMA,
    amount,
    checkpoint_of,
    estimate,
    extended_options,
    has_network,
    interval,
    model_yaml,
    plain_report,
    rebuilt,
    sentence,
    write_report,
)
from nnode.diagnosis.result import (
    Alternative,
    Coefficient,
    Confirmation,
    DataFault,
    Gap,
)
from nnode.diagnosis.single_law import _shift
from nnode.model import System, build_model
from nnode.model.build import add_effects
from nnode.model.effects.lane import SpeedZone
from nnode.model.extend import effects_of, extended
from tests.diagnosis.conftest import Case


def test_fields_of_report(traffic: Case, tmp_path: Path) -> None:
    d = replace(traffic.found.diagnosis, gap=Gap(np.float64(2.0), 1.0, float("nan"), float("inf")))
    path = write_report(plain_report(d), tmp_path / "report.json")

    def no_constant(name: str) -> None:
        pytest.fail(f"{name} is no JSON")

    report = json.loads(path.read_text(), parse_constant=no_constant)
    assert next(iter(report.items())) == ("schema", SCHEMA)
    page = (Path(__file__).parents[3] / "docs" / "discovery.md").read_text(encoding="utf-8")
    assert f"now {SCHEMA};" in page
    assert report["verdict"] == "named"
    numbers = {"before": 2.0, "after": 1.0, "noise_floor": None, "closed": None}
    assert report["gap"] == {**numbers, "plain": None, "plain_after": None, "definition": ""}
    (effect,) = report["effects"]
    assert effect["name"] == "speed_zone"
    assert set(effect) >= {"coefficients", "where", "alternatives", "formula", "source", "p_value"}
    assert set(effect["coefficients"]["alpha"]) == {"value", "low", "high", "unit"}
    assert report["not_testable"] == ["reaction_delay"]
    assert report["data_faults"] == report["hypotheses"] == []
    assert report["clusters"]["exploration"] + report["clusters"]["confirmation"] == 5
    assert set(report["screen"]) >= {"p_value", "clusters", "floor", "strongest"}
    assert report["confirmation"]["confirmed"] is True
    (drivers,) = report["agents"]
    assert drivers["share"] == {"recording": None, "sequence": 0.2, "agent": 0.5, "transient": 0.3}
    assert {"name", "before", "after"} == set(report["confirmation_errors"][0])


@pytest.mark.parametrize(
    ("value", "text"),
    [(2035.19, "2040"), (-0.06123, "−0.0612"), (float("nan"), "–"), (None, "–"), (0.5, "0.5")],
)
def test_amount(value: float | None, text: str) -> None:
    assert amount(value) == text


def test_interval(traffic: Case) -> None:
    (effect,) = traffic.found.diagnosis.effects
    assert interval(effect).startswith("alpha = 0.650 [0.627, 0.680], a = 400.0 [392.0, 400.0] m")


@pytest.mark.parametrize(
    ("low", "value", "high", "words"),
    [
        (399.756, 399.8268, 399.897, ("399.827", "399.756", "399.897")),
        (-12.2, -11.0, -9.1, ("−11.0", "−12.2", "−9.1")),
        (150.0, 400.0, 700.0, ("400", "150", "700")),
        (float("nan"), 0.12345, float("nan"), ("0.1235", "–", "–")),
    ],
)
def test_digits_of_estimate_depend_on_interval(
    low: float, value: float, high: float, words: tuple[str, str, str]
) -> None:
    assert estimate(Coefficient(value, low, high, "m")) == words


JUMPS = [DataFault("jump", f"lane/{i}", ["v1"], 3.0) for i in (1, 1, 2)]


@pytest.mark.parametrize(
    ("changes", "facts"),
    [
        ({}, "lacks speed_zone: | from 5 to 1 m² | 89 % | (0.5 m²)"),
        ({"effects": [], "verdict": "none"}, "No missing effect was found: "),
        ({"verdict": "unknown"}, ", beyond speed_zone, | depends on position and gap."),
        ({"verdict": "indistinguishable"}, "cannot distinguish speed_zone from inertia: "),
        (
            {"verdict": "not_testable"},
            " 3 exploration clusters and 2 confirmation clusters, | about 17 clusters",
        ),
        ({"verdict": "not_testable", "least_exploration": 2}, "These data cannot test the model: "),
        ({"hypotheses": True}, "lacks speed_zone | inertia remains a hypothesis: no better."),
        (
            {"verdict": "unknown", "law_at_bounds": ["lin.L"], "hypotheses": True},
            "not the law of these data: lin.L ends at a bound | values, with inertia added.",
        ),
        ({"data_faults": JUMPS}, "lacks speed_zone | 2 sequences with 3 faults "),
    ],
)
def test_sentence_has_facts_of_verdict(traffic: Case, changes: dict[str, Any], facts: str) -> None:
    d = traffic.found.diagnosis
    (effect,) = d.effects
    effect = replace(effect, alternatives=[Alternative("inertia", 1.0, 0.5)])
    changes = {"effects": [effect], **changes}
    if "least_exploration" in changes:
        least = changes.pop("least_exploration")
        changes["clusters"] = replace(d.clusters, least_exploration=least)
    if "hypotheses" in changes:
        changes["hypotheses"] = [replace(effect, name="inertia")]
    confirmation = Confirmation(0.4, 5, False, "no better")
    gap = Gap(5.0, 1.0, 0.5, 8 / 9)
    text = sentence(replace(d, confirmation=confirmation, gap=gap, **changes))
    assert text.endswith(".")
    for fact in facts.split(" | "):
        assert fact in text


def assert_equal(actual: System, expected: System) -> None:
    states = actual.state_dict(), expected.state_dict()
    assert set(states[0]) == set(states[1])
    for key, value in states[1].items():
        torch.testing.assert_close(states[0][key], value, rtol=0, atol=0)


@pytest.mark.parametrize("name", ["traffic", "crowd"])
def test_options_of_extended_model(name: str, request: pytest.FixtureRequest) -> None:
    case: Case = request.getfixturevalue(name)
    options = extended_options(case.model, case.found.extended)
    assert_equal(build_model(options), case.found.extended)
    text = model_yaml(options, False)
    read = yaml.safe_load(text)
    assert read.pop("defaults") == [f"{case.model['term']}_schema", "_self_"]
    assert read == options
    assert options["name"] in text.splitlines()[0]


def test_rebuilt_model_keeps_parameters_of_effects_in_any_order(traffic: Case) -> None:
    system = build_model(traffic.model)
    add_effects(system, [{"name": "relative_speed", "kappa": 0.2}])
    add_effects(system, [{"name": "speed_zone", "alpha": 0.5, "a": 1.0, "b": 2.0}])
    assert [e.name for e in effects_of(system)] == ["relative_speed", "speed_zone"]
    copy = rebuilt(extended_options(traffic.model, system), system)
    assert copy.physical() == system.physical()


def test_rebuilt_network_keeps_weights(traffic: Case) -> None:
    options = {"name": "n2", "term": "network_speed", "hidden": 2, "v0": 30.0, "box": None}
    system = build_model({**options, "leader": "measured"}, seed=3)
    assert has_network(system)
    assert not has_network(traffic.found.base)
    assert_equal(rebuilt({**options, "leader": "measured", "effects": []}, system), system)
    assert "these would be new" in model_yaml(options, True)


def test_checkpoint(traffic: Case) -> None:
    outcome = traffic.found
    model = extended_options(traffic.model, outcome.extended)
    config = {"model": model, "seed": 0, "trainer": {**vars(TrainerOptions()), "dtype": "float64"}}
    checkpoint = checkpoint_of(outcome, traffic.inputs.sequences, config, {}, AdadeltaOptions())
    assert checkpoint.split["heldout"] == outcome.diagnosis.split["confirmation"]
    assert checkpoint.split["train"] == outcome.diagnosis.split["exploration"]
    # the leaders' speeds are 14 to 22 m/s
    assert checkpoint.free_speed is not None
    assert 5 < checkpoint.free_speed < 27
    assert checkpoint.build().physical() == outcome.extended.physical()


def test_shift_of_parameters_of_same_name(traffic: Case) -> None:
    before = build_model(traffic.model)
    add_effects(before, [{"name": "speed_period", "alpha": 0.7}])
    # the zone precedes the period, and its parameters have the same names
    after, _ = extended(before, SpeedZone(alpha=0.9))
    shift = _shift(before, after)
    assert shift["speed_period.alpha"] == {"before": 0.7, "after": 0.7, "unit": "1"}
    assert [name for name in shift if name.endswith("alpha")] == ["speed_period.alpha"]
