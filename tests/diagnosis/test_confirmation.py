"""Confirmation of effects by held-back clusters."""

from __future__ import annotations

import html
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from nnode.app.discover import diagnose_table
from nnode.calibrate.checkpoint import load_checkpoint
from nnode.data.clusters import least_number
from nnode.data.sequences import Sequences
from nnode.diagnosis.compare import BetterLaw
from nnode.diagnosis.division import divide
from nnode.diagnosis.options import DiscoverOptions
from nnode.diagnosis.report.files import sentence
from nnode.diagnosis.single_law import diagnose_law
from nnode.model.effects import CATALOGUE, IndividualEffect
from nnode.model.extend import effects_of
from tests.diagnosis.conftest import KAPPA, MANY
from tests.diagnosis.platoons import lin, platoons, relative_speed

OPTIONS = DiscoverOptions(effects=["relative_speed"], structure=False)
LAW = lin(v0=25.0, length=7.0)


@pytest.fixture(scope="module")
def unconfirmed(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """A report and its folder. Confirmation platoons react opposite to exploration platoons."""
    folder = tmp_path_factory.mktemp("unconfirmed") / "run"
    exploration, opposite = (platoons(relative_speed(s * KAPPA), **MANY) for s in (1, -1))
    confirmation = divide(exploration, OPTIONS).confirmation.places
    sequences = [(opposite if i in confirmation else exploration)[i] for i in range(len(opposite))]
    table = Sequences(sequences).to_dataframe()
    options = replace(OPTIONS, compare=[], replay=False)
    report = diagnose_table(table, "traffic", model="lin", folder=folder, options=options)
    return report.plain(), folder


def test_effect_that_confirmation_contradicts(
    unconfirmed: tuple[dict[str, Any], Path],
) -> None:
    report, _ = unconfirmed
    assert (report["verdict"], report["effects"]) == ("none", [])
    (hypothesis,) = report["hypotheses"]
    assert hypothesis["name"] == "relative_speed"
    # the smallest p-value of eleven exploration clusters
    assert (report["clusters"]["exploration"], report["clusters"]["confirmation"]) == (11, 5)
    assert report["screen"]["p_value"] == hypothesis["p_value"] == 2**-10
    assert hypothesis["coefficients"]["kappa"]["value"] == pytest.approx(KAPPA, abs=0.05)
    # the errors of all confirmation clusters rise
    assert hypothesis["confirmed"] == report["confirmation"]["p_value"] == 1.0
    assert report["confirmation"]["confirmed"] is False


def test_files_of_unconfirmed_effect(
    unconfirmed: tuple[dict[str, Any], Path],
) -> None:
    _, folder = unconfirmed
    model = load_checkpoint(folder / "checkpoints" / "best.pt").build()
    assert effects_of(model) == []
    assert set(model.physical()) == {"lin.v0", "lin.L"}
    options = yaml.safe_load((folder / "model.yaml").read_text())
    assert (options["effects"], options["name"]) == ([], "lin_calibrated")
    page = html.unescape((folder / "report.html").read_text())
    hypothesis = page.index("relative_speed remains a hypothesis: ")
    assert hypothesis < page.index("Coefficients</h2>")


@pytest.mark.parametrize("confirmation", [2, 1])
def test_confirmation_requires_two_clusters(confirmation: int) -> None:
    number = 7 + confirmation
    options = replace(OPTIONS, confirmation=confirmation / number)
    sequences = platoons(relative_speed(KAPPA), **{**MANY, "number": number})
    # a law that predicts no better than the model with the effect does not replace it
    outcome = diagnose_law(LAW, sequences, options, nearer=BetterLaw("lin", LAW))
    d = outcome.diagnosis
    assert d.clusters.confirmation == confirmation
    if confirmation == 2:
        assert (d.verdict, d.hypotheses) == ("named", [])
        (effect,) = d.effects
        # 2^-2 is the smallest p-value of two clusters; that of the exploration clusters is small
        assert effect.confirmed == 0.25
        assert effect.combined < 0.05
    else:
        assert (d.verdict, d.effects) == ("none", [])
        assert [hypothesis.name for hypothesis in d.hypotheses] == ["relative_speed"]
        assert "requires 2" in d.confirmation.reason
        assert effects_of(outcome.extended) == []


def test_too_few_clusters() -> None:
    sequences = platoons(relative_speed(KAPPA), **{**MANY, "number": 11})
    d = diagnose_law(LAW, sequences, DiscoverOptions(structure=False)).diagnosis
    assert (d.verdict, d.effects, d.hypotheses) == ("not_testable", [], [])
    # eight exploration clusters have 2^7 outcomes, too few for the number of effects
    effects = {e.name for e in CATALOGUE.of("traffic") if not issubclass(e, IndividualEffect)}
    clusters = d.clusters
    assert clusters.least_exploration == least_number(0.05, hypotheses=len(effects))
    assert clusters.exploration == 8 < clusters.least_exploration
    assert not any(absence.testable for absence in d.absences if absence.name in effects)
    assert "8 exploration clusters and 3 confirmation clusters" in sentence(d)
    assert f"about {clusters.enough} clusters are needed" in sentence(d)
    # the stated number is enough, and three fewer are not
    for number, expected in ((clusters.enough, True), (clusters.enough - 3, False)):
        parts = divide(platoons(number=number, seconds=1.0), DiscoverOptions())
        enough = (
            parts.exploration.clusters >= clusters.least_exploration
            and parts.confirmation.clusters >= clusters.least_confirmation
        )
        assert enough == expected
    # the strongest effects are reported nevertheless
    assert d.screen.strongest[0]["name"] in ("relative_speed", "asymmetric_response")


def test_effect_is_confirmed_with_different_drivers() -> None:
    paces = 1 + 0.03 * np.random.default_rng(2).normal(size=(16, 4))
    reaction = relative_speed(KAPPA)
    sequences = platoons(
        lambda x, law, lead: reaction(x, paces * law, lead), number=16, driver=0.1, seed=200
    )
    d = diagnose_law(LAW, sequences, OPTIONS).diagnosis
    assert d.verdict == "named"
    assert d.effects[0].name == "relative_speed"
    kappa = d.effects[0].coefficients["kappa"]
    assert kappa.low < KAPPA < kappa.high
    assert kappa.value == pytest.approx(KAPPA, abs=0.05)
    v0 = next(parameter for parameter in d.drivers if parameter.name == "v0")
    assert 2.0 < v0.estimate < 4.5
    assert v0.lower < 3.0 < v0.upper
    assert "relative_speed" not in {absence.name for absence in d.absences}
