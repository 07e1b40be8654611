"""Names are confirmed by clusters that nothing looked at, or they are hypotheses."""

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
from nnode.data.sequence import Sequence
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


def turned() -> list[Sequence]:
    """Platoons whose confirmation ones react the other way round."""
    forth, back = (platoons(relative_speed(s * KAPPA), **MANY) for s in (1, -1))
    confirmation = divide(forth, OPTIONS).confirmation.places
    return [back[i] if i in confirmation else one for i, one in enumerate(forth)]


@pytest.fixture(scope="module")
def unconfirmed(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """The report and the folder of a diagnosis whose confirmation clusters contradict the
    exploration clusters."""
    folder = tmp_path_factory.mktemp("unconfirmed") / "run"
    table = Sequences(turned()).to_dataframe()
    options = replace(OPTIONS, compare=[], replay=False)
    report = diagnose_table(table, "traffic", model="lin", folder=folder, options=options)
    return report.plain(), folder


def test_what_is_worse_on_sealed_clusters_is_not_confirmed(
    unconfirmed: tuple[dict[str, Any], Path],
) -> None:
    report, _ = unconfirmed
    assert (report["verdict"], report["effects"]) == ("none", [])
    (lead,) = report["hypotheses"]
    assert lead["name"] == "relative_speed"
    # the open clusters do say so: the least p that eleven of them allow
    assert (report["clusters"]["exploration"], report["clusters"]["confirmation"]) == (11, 5)
    assert report["screen"]["p_value"] == lead["p_value"] == 2**-10
    assert lead["coefficients"]["kappa"]["value"] == pytest.approx(KAPPA, abs=0.05)
    # the confirmation ones are all worse
    assert lead["confirmed"] == report["confirmation"]["p_value"] == 1.0
    assert report["confirmation"]["confirmed"] is False


def test_what_is_not_confirmed_is_a_hypothesis_in_every_file(
    unconfirmed: tuple[dict[str, Any], Path],
) -> None:
    _, folder = unconfirmed
    own = load_checkpoint(folder / "checkpoints" / "best.pt").build()
    assert effects_of(own) == []
    assert set(own.physical()) == {"lin.v0", "lin.L"}
    written = yaml.safe_load((folder / "model.yaml").read_text())
    assert (written["effects"], written["name"]) == ([], "lin_calibrated")
    page = html.unescape((folder / "report.html").read_text())
    first = page.index("relative_speed remains a hypothesis: ")
    assert first < page.index("Coefficients</h2>")


@pytest.mark.parametrize(("number", "confirmation"), [(7, 2), (7, 1)])
def test_two_confirmation_clusters_are_enough_and_one_is_not(
    number: int, confirmation: int
) -> None:
    options = replace(OPTIONS, confirmation=confirmation / (number + confirmation))
    made = platoons(relative_speed(KAPPA), **{**MANY, "number": number + confirmation})
    # a law that predicts no better than the model with the effect does not take its place
    found = diagnose_law(LAW, made, options, nearer=BetterLaw("lin", LAW))
    d = found.diagnosis
    assert d.clusters.confirmation == confirmation
    if confirmation == 2:
        assert (d.verdict, d.hypotheses) == ("named", [])
        (effect,) = d.effects
        # 2^-2 is the least p-value of two clusters, and the exploration clusters are sure
        assert effect.confirmed == 0.25
        assert effect.combined < 0.05
    else:
        assert (d.verdict, d.effects) == ("none", [])
        assert [one.name for one in d.hypotheses] == ["relative_speed"]
        assert "requires 2" in d.confirmation.reason
        assert effects_of(found.extended) == []


def test_with_too_few_clusters_nothing_is_named_and_it_says_how_many_would_do() -> None:
    sequences = platoons(relative_speed(KAPPA), **{**MANY, "number": 11})
    found = diagnose_law(LAW, sequences, DiscoverOptions(structure=False))
    d = found.diagnosis
    assert (d.verdict, d.effects, d.hypotheses) == ("not_testable", [], [])
    # eight open clusters have 2^7 outcomes, too few for so many effects
    effects = [one for one in CATALOGUE.of("traffic") if not issubclass(one, IndividualEffect)]
    assert (
        d.clusters.exploration
        == 8
        < d.clusters.least_exploration
        == least_number(0.05, hypotheses=len(effects))
    )
    assert not any(one.testable for one in d.absences if one.name in {e.name for e in effects})
    assert "8 exploration clusters and 3 confirmation clusters" in sentence(d)
    assert f"about {d.clusters.enough} clusters are needed" in sentence(d)
    # so many would do, and not many fewer
    for number, do in ((d.clusters.enough, True), (d.clusters.enough - 3, False)):
        parts = divide(platoons(number=number, seconds=1.0), DiscoverOptions())
        least = d.clusters.least_exploration, d.clusters.least_confirmation
        enough = parts.exploration.clusters >= least[0] and parts.confirmation.clusters >= least[1]
        assert enough == do
    # what one would look at first is told all the same
    assert d.screen.strongest[0]["name"] in ("relative_speed", "asymmetric_response")


def test_an_effect_of_all_is_named_although_drivers_differ() -> None:
    own = 1 + 0.03 * np.random.default_rng(2).normal(size=(16, 4))
    reaction = relative_speed(KAPPA)
    made = platoons(
        lambda x, law, lead: reaction(x, own * law, lead), number=16, driver=0.1, seed=200
    )
    d = diagnose_law(LAW, made, OPTIONS).diagnosis
    assert d.verdict == "named"
    assert d.effects[0].name == "relative_speed"
    kappa = d.effects[0].coefficients["kappa"]
    assert kappa.low < KAPPA < kappa.high
    assert kappa.value == pytest.approx(KAPPA, abs=0.05)
    # how drivers differ stands beside it
    found = {one.name: one for one in d.drivers}
    assert 2.0 < found["v0"].estimate < 4.5
    assert found["v0"].lower < 3.0 < found["v0"].upper
    assert "relative_speed" not in {one.name for one in d.absences}
