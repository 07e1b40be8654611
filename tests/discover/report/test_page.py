"""The page and the events of a diagnosis, with results made by hand."""

from __future__ import annotations

import re
from collections import defaultdict
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from nnode.data.quality import Fault
from nnode.data.sequence import Sequence
from nnode.discover.inputs import Inputs
from nnode.discover.judge.confirmation import defined
from nnode.discover.report.files import verdict
from nnode.discover.report.page import draw, page_blocks
from nnode.discover.report.replay import scenes, zones
from nnode.discover.result import Coefficient, Confirmation, DataFault
from nnode.model import build_model
from nnode.model.build import add_effects
from nnode.pages.page import Heading, TableBlock, Text
from nnode.pages.replay import typical
from tests.discover.conftest import Case
from tests.discover.recorded import ZONE

CONFIG = {"data": {"name": "table"}, "model": {"name": "lin_with_speed_zone"}}


def with_faults(case: Case) -> Inputs:
    """The case's inputs beside a sequence in which a vehicle jumps."""
    first = case.inputs.sequences[0]
    x = first.x.copy()
    x[20:, 1] += 50.0
    bad = Sequence(name="lane/bad", recording="lane", time=first.time, x=x)
    fault = Fault("jump", "lane/bad", (1,), float(first.time[20]), "car 1 jumps")
    return replace(
        case.inputs,
        faulty=[bad],
        faults={"lane/bad": [fault]},
        data_faults=[DataFault("jump", "lane/bad", ["1"], fault.time, fault.detail)],
    )


@pytest.fixture(scope="module")
def written(traffic: Case, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    inputs = with_faults(traffic)
    found = deepcopy(traffic.found)
    found.diagnosis.data_faults = inputs.data_faults
    write = draw(inputs, found, traffic.options, CONFIG, ["nnode evaluate X"], folder)
    assert list(folder.iterdir()) == []  # drawn is not written
    paths = write()
    assert paths == {"page": folder / "report.html", "tensorboard": folder / "tensorboard"}
    return folder


def test_the_page_is_one_file_with_the_verdict_first(written: Path, traffic: Case) -> None:
    page = (written / "report.html").read_text()
    assert not re.findall(r'(?:src|href)="(?!data:|#)', page)
    told = verdict(traffic.found.diagnosis)
    assert page.index(told) < page.index("Where the model deviates from the data</h2>")
    order = [
        "Where the model deviates from the data",
        "Errors on confirmation sequences",
        "Coefficients",
        "Differences between agents",
        "How it was decided",
        "A typical confirmation sequence",
        "Deviations by variable",
        "Unexplained structure",
        "Effects that were not found",
        "Faults of the measurement",
        "Using the extended model",
        "Independent clusters",
        "How this page was made",
    ]
    heads = re.findall(r"<h2[^>]*>([^<]*)</h2>", page)
    assert heads == order
    folded = re.findall(r"<summary><h2[^>]*>([^<]*)</h2></summary>", page)
    assert folded == ["Independent clusters"]
    for words in (
        "nnode evaluate X",
        "−6.1 ± 0.4",
        "71 %",
        "platoons at other times",
        "car 1 jumps",
        "made by hand",
        "5 sequences are confirmation sequences",
        traffic.found.diagnosis.gap.definition,
        "No two-sided p-value can be below 0.001 with 3 exploration clusters.",
        "no: the last part of the sealed sequences",
    ):
        assert words in page, words


def test_every_figure_has_words_and_every_table_a_file(written: Path) -> None:
    names = {path.stem for path in (written / "figures").iterdir()}
    assert names == {
        "coefficients",
        "faults",
        "map",
        "map_beside",
        "sealed",
        "trajectories",
        "unknown",
        "where",
    }
    alts = re.findall(r'<img alt="([^"]*)"', (written / "report.html").read_text())
    assert len(alts) == len(names)
    assert all(len(alt) > 20 for alt in alts)
    table = pd.read_csv(written / "coefficients.csv")
    assert list(table["coefficient"]) == ["alpha", "a", "b"]
    assert list(pd.read_csv(written / "data_faults.csv")["sequence"]) == ["lane/bad"]


def test_tensorboard_shows_before_and_after(written: Path, traffic: Case) -> None:
    events = EventAccumulator(str(written / "tensorboard")).Reload()
    gap = traffic.found.diagnosis.gap
    assert [e.value for e in events.Scalars("gap/sealed")] == pytest.approx([gap.before, gap.after])
    assert [e.value for e in events.Scalars("parameters/lin.v0")] == [24.0, 27.0]
    assert [e.value for e in events.Scalars("effects/speed_zone/alpha")] == pytest.approx([0.65])
    assert "diagnosis/map" in events.Tags()["images"]


def test_a_crowd_s_page(crowd: Case, tmp_path: Path) -> None:
    still = replace(crowd.options, replay=False)
    draw(crowd.inputs, crowd.found, still, CONFIG, [], tmp_path)()
    page = (tmp_path / "report.html").read_text()
    assert "Mean of measured minus simulated acceleration by position" in page
    assert "made_up_wind" in page


def plain(case: Case, **changes: object) -> list[str]:
    """The words of a page without figures."""
    found = deepcopy(case.found)
    found.diagnosis = replace(found.diagnosis, **changes)
    blocks = page_blocks(case.inputs, found, defaultdict(list), [], Path("run"))
    return [
        b.text if isinstance(b, Heading) else b.markdown if isinstance(b, Text) else b.name
        for b in blocks
        if isinstance(b, Text | Heading | TableBlock)
    ]


def test_a_page_of_nothing_found(traffic: Case) -> None:
    words = plain(
        traffic,
        effects=[],
        verdict="none",
        unknown=None,
        places=[],
        absences=[],
        not_testable=[],
        sealed=[],
        base={},
        notes=[],
        agents=[],
    )
    assert "No effect of the catalogue was added to the model." in words
    assert "No sequence has a fault." in words
    assert "No curve is significant in the remaining residuals." in words
    assert not any("network" in text for text in words)
    assert "Differences between agents" not in words
    assert "leads" not in words


def test_hypotheses_that_were_not_confirmed_are_listed_with_the_reason(traffic: Case) -> None:
    d = traffic.found.diagnosis
    no = Confirmation(0.4, 5, False, "the errors do not fall")
    words = plain(traffic, effects=[], verdict="none", leads=d.effects, confirmation=no)
    assert words[words.index("leads") - 1] == "Reason: the errors do not fall."


def test_where_nothing_can_be_tested_the_first_screen_is_described(traffic: Case) -> None:
    assert "screen" in plain(traffic, effects=[], verdict="not_testable")


def test_a_network_is_told_to_hide_effects(traffic: Case) -> None:
    case = deepcopy(traffic)
    options = {"name": "n2", "term": "network_speed", "hidden": 2, "v0": 30.0, "box": None}
    case.found.base = build_model({**options, "leader": "measured"})
    words = plain(case)
    assert any(text.startswith("**The model is a network.**") for text in words)
    assert any("weights of the network are stored in the checkpoint only" in text for text in words)


def test_numbers_of_agents_are_said_to_be_unknown_elsewhere(traffic: Case) -> None:
    case = deepcopy(traffic)
    people = {case.inputs.sequences[0].name: [0.1, 0.0, -0.1, 0.0]}
    add_effects(case.found.extended, [{"name": "driver_heterogeneity", "people": people}])
    (own,) = case.found.diagnosis.agents
    gap = replace(case.found.diagnosis.gap, definition=defined("traffic", True))
    words = plain(case, agents=[replace(own, named=True, reason="")], gap=gap)
    assert any("each agent's number is taken from the first 40 %" in text for text in words)
    assert any("acts only on agents of the exploration sequences" in text for text in words)


def test_the_player_opens_on_the_sequence_with_the_median_error(traffic: Case) -> None:
    found = deepcopy(traffic.found)
    ((simulation, _), *_) = found.simulated
    assert simulation is not None
    errors = [4.0, 9.0, 1.0, float("inf"), 16.0]  # a simulation that diverged is not shown
    sequences = [replace(simulation.sequence, name=f"s{error:g}") for error in errors]
    moved = [
        replace(simulation, sequence=s, x=s.x + np.sqrt(error))
        for s, error in zip(sequences, errors, strict=True)
    ]
    found.simulated = [(one, one) for one in moved]
    rows = [
        {"name": s.name, "before": e, "after": e} for s, e in zip(sequences, errors, strict=True)
    ]
    found.diagnosis = replace(found.diagnosis, sealed=rows)
    shown = scenes(found)
    assert [scene.sequence.name for scene in shown] == ["s16", "s9", "s4", "s1"]
    assert shown[typical(shown)].sequence.name == "s4"


def test_the_named_place_is_shaded_and_else_the_largest_deviation(traffic: Case) -> None:
    d = deepcopy(traffic.found.diagnosis)
    a, b = ZONE
    (zone,) = zones(d)
    assert (zone.label, zone.t, zone.circle) == ("speed_zone", None, None)
    assert zone.x == pytest.approx((a, b))
    (zone,) = zones(replace(d, effects=[]))
    assert (zone.label, zone.x) == ("largest deviation", (a, b))
    assert zones(replace(d, effects=[], places=[])) == []
    (effect,) = d.effects
    at = {
        name: Coefficient(value, value, value, unit)
        for name, value, unit in (
            ("A_o", 1.0, "m/s²"),
            ("B_o", 0.6, "m"),
            ("x_o", -1.0, "m"),
            ("y_o", 2.0, "m"),
        )
    }
    (zone,) = zones(replace(d, effects=[replace(effect, name="obstacle", coefficients=at)]))
    assert zone.circle == (-1.0, 2.0, 0.6)
    at = {name: Coefficient(value, value, value, "s") for name, value in (("a", 3.0), ("b", 9.0))}
    (zone,) = zones(replace(d, effects=[replace(effect, coefficients=at)]))
    assert (zone.t, zone.x) == ((3.0, 9.0), None)
