"""The report in plain types, and the extended model as options and as a checkpoint."""

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
from nnode.model import build_model
from nnode.model.build import add_effects
from nnode.model.effects.lane import SpeedZone
from nnode.model.extend import effects_of, extended
from tests.diagnosis.conftest import Case


def test_the_report_holds_what_programs_rely_on(traffic: Case, tmp_path: Path) -> None:
    d = replace(traffic.found.diagnosis, gap=Gap(np.float64(2.0), 1.0, float("nan"), float("inf")))
    path = write_report(plain_report(d), tmp_path / "report.json")

    def no_constant(name: str) -> None:
        pytest.fail(f"{name} is no JSON")

    report = json.loads(path.read_text(), parse_constant=no_constant)
    assert next(iter(report.items())) == ("schema", SCHEMA)
    page = (Path(__file__).parents[3] / "docs" / "discovery.md").read_text(encoding="utf-8")
    assert f"now {SCHEMA};" in page
    assert report["verdict"] == "named"
    known = {"before": 2.0, "after": 1.0, "noise_floor": None, "closed": None}
    assert report["gap"] == {**known, "plain": None, "plain_after": None, "definition": ""}
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
    assert drivers["share"] == {"recording": None, "sequence": 0.2, "agent": 0.5, "mood": 0.3}
    assert {"name", "before", "after"} == set(report["confirmation_errors"][0])


@pytest.mark.parametrize(
    ("value", "text"),
    [(2035.19, "2040"), (-0.06123, "−0.0612"), (float("nan"), "–"), (None, "–"), (0.5, "0.5")],
)
def test_amounts_in_words(value: float | None, text: str) -> None:
    assert amount(value) == text


def test_coefficients_in_words(traffic: Case) -> None:
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
def test_an_estimate_has_the_digits_that_its_interval_leaves(
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
def test_the_sentence_has_the_facts_of_a_verdict(
    traffic: Case, changes: dict[str, Any], facts: str
) -> None:
    d = traffic.found.diagnosis
    (effect,) = d.effects
    effect = replace(effect, alternatives=[Alternative("inertia", 1.0, 0.5)])
    changes = {"effects": [effect], **changes}
    if "least_exploration" in changes:
        least = changes.pop("least_exploration")
        changes["clusters"] = replace(d.clusters, least_exploration=least)
    if "hypotheses" in changes:
        changes["hypotheses"] = [replace(effect, name="inertia")]
    no = Confirmation(0.4, 5, False, "no better")
    said = sentence(replace(d, confirmation=no, gap=Gap(5.0, 1.0, 0.5, 8 / 9), **changes))
    assert said.endswith(".")
    for fact in facts.split(" | "):
        assert fact in said


@pytest.mark.parametrize("name", ["traffic", "crowd"])
def test_the_options_give_the_extended_model(name: str, request: pytest.FixtureRequest) -> None:
    case: Case = request.getfixturevalue(name)
    options = extended_options(case.model, case.found.extended)
    model = build_model(options)
    expected = case.found.extended.state_dict()
    found = model.state_dict()
    assert set(found) == set(expected)
    for key, value in expected.items():
        torch.testing.assert_close(found[key], value, rtol=0, atol=0)
    text = model_yaml(options, False)
    read = yaml.safe_load(text)
    assert read.pop("defaults") == [f"{case.model['term']}_schema", "_self_"]
    assert read == options
    assert options["name"] in text.splitlines()[0]


def test_effects_find_their_parameters_in_any_order(traffic: Case) -> None:
    system = build_model(traffic.model)
    add_effects(system, [{"name": "relative_speed", "kappa": 0.2}])
    add_effects(system, [{"name": "speed_zone", "alpha": 0.5, "a": 1.0, "b": 2.0}])
    assert [e.name for e in effects_of(system)] == ["relative_speed", "speed_zone"]
    again = rebuilt(extended_options(traffic.model, system), system)
    assert again.physical() == system.physical()


def test_a_network_keeps_its_weights_in_the_checkpoint(traffic: Case) -> None:
    options = {"name": "n2", "term": "network_speed", "hidden": 2, "v0": 30.0, "box": None}
    system = build_model({**options, "leader": "measured"}, seed=3)
    assert has_network(system)
    assert not has_network(traffic.found.base)
    again = rebuilt({**options, "leader": "measured", "effects": []}, system)
    for key, value in system.state_dict().items():
        torch.testing.assert_close(again.state_dict()[key], value, rtol=0, atol=0)
    assert "these would be new" in model_yaml(options, True)


def test_the_checkpoint_has_the_diagnosis_own_parts(traffic: Case) -> None:
    model = extended_options(traffic.model, traffic.found.extended)
    config = {"model": model, "seed": 0, "trainer": {**vars(TrainerOptions()), "dtype": "float64"}}
    checkpoint = checkpoint_of(
        traffic.found, traffic.inputs.sequences, config, {}, AdadeltaOptions()
    )
    assert checkpoint.split["heldout"] == traffic.found.diagnosis.split["confirmation"]
    assert checkpoint.split["train"] == traffic.found.diagnosis.split["exploration"]
    # cars behind a leader at 14 to 22 m/s
    assert checkpoint.free_speed is not None
    assert 5 < checkpoint.free_speed < 27
    assert checkpoint.build().physical() == traffic.found.extended.physical()


def test_a_parameter_is_compared_with_itself_whatever_joins_the_model(traffic: Case) -> None:
    before = build_model(traffic.model)
    add_effects(before, [{"name": "speed_period", "alpha": 0.7}])
    # the zone stands before the period in the sum, and its parameters have the same names
    after, _ = extended(before, SpeedZone(alpha=0.9))
    shift = _shift(before, after)
    period = {"before": 0.7, "after": 0.7, "unit": "1"}
    assert shift["speed_period.alpha"] == period
    assert [name for name in shift if name.endswith("alpha")] == ["speed_period.alpha"]
