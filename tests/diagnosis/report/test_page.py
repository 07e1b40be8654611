"""The page and the events of a diagnosis with made results."""

from __future__ import annotations

import re
from collections import defaultdict
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from nnode.data.quality import Fault
from nnode.data.sequence import Sequence
from nnode.diagnosis.inputs import Inputs
from nnode.diagnosis.report.files import verdict
from nnode.diagnosis.report.page import draw, page_blocks
from nnode.diagnosis.report.replay import scenes, zones
from nnode.diagnosis.result import Coefficient, ComparedLaw, Confirmation, DataFault, Laws
from nnode.model import build_model
from nnode.model.build import add_effects
from nnode.pages.page import Heading, TableBlock, Text
from nnode.pages.replay import Zone, typical
from tests.diagnosis.conftest import Case
from tests.diagnosis.recorded import ZONE

CONFIG = {"data": {"name": "table"}, "model": {"name": "lin_with_speed_zone"}}


def with_faults(case: Case) -> Inputs:
    """The case's inputs and an excluded sequence in which a vehicle jumps."""
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
    outcome = deepcopy(traffic.found)
    outcome.diagnosis.data_faults = inputs.data_faults
    write = draw(inputs, outcome, traffic.options, CONFIG, ["nnode evaluate X"], folder)
    assert list(folder.iterdir()) == []  # nothing is written yet
    paths = write()
    assert paths == {"page": folder / "report.html", "tensorboard": folder / "tensorboard"}
    return folder


def test_order_of_page(written: Path, traffic: Case) -> None:
    page = (written / "report.html").read_text()
    assert not re.findall(r'(?:src|href)="(?!data:|#)', page)
    headings = [
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
    assert page.index(verdict(traffic.found.diagnosis)) < page.index(f"{headings[0]}</h2>")
    assert re.findall(r"<h2[^>]*>([^<]*)</h2>", page) == headings
    folded = re.findall(r"<summary><h2[^>]*>([^<]*)</h2></summary>", page)
    assert folded == ["Independent clusters"]
    assert "car 1 jumps" in page  # the fault of the excluded sequence


def test_figures_have_descriptions_and_tables_have_files(written: Path) -> None:
    names = {path.stem for path in (written / "figures").iterdir()}
    assert names == {
        "coefficients",
        "faults",
        "map",
        "map_beside",
        "confirmation",
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


def test_tensorboard_events(written: Path, traffic: Case) -> None:
    events = EventAccumulator(str(written / "tensorboard")).Reload()
    gap = traffic.found.diagnosis.gap
    assert [e.value for e in events.Scalars("gap/confirmation")] == pytest.approx(
        [gap.before, gap.after]
    )
    assert [e.value for e in events.Scalars("parameters/lin.v0")] == [24.0, 27.0]
    assert [e.value for e in events.Scalars("effects/speed_zone/alpha")] == pytest.approx([0.65])
    assert "diagnosis/map" in events.Tags()["images"]


def test_page_of_crowd(crowd: Case, tmp_path: Path) -> None:
    options = replace(crowd.options, replay=False)
    draw(crowd.inputs, crowd.found, options, CONFIG, [], tmp_path)()
    page = (tmp_path / "report.html").read_text()
    assert "Mean of measured minus simulated acceleration by position" in page
    assert "made_up_wind" in page


def words_of(case: Case, **changes: Any) -> list[str]:
    """Texts of a page without figures, and the names of its tables.

    Args:
        changes: of the diagnosis; ``base`` and ``extended`` are other models.
    """
    outcome = deepcopy(case.found)
    outcome.base = changes.pop("base", outcome.base)
    outcome.extended = changes.pop("extended", outcome.extended)
    outcome.diagnosis = replace(outcome.diagnosis, **changes)
    blocks = page_blocks(case.inputs, outcome, defaultdict(list), [], Path("run"))
    return [
        b.text if isinstance(b, Heading) else b.markdown if isinstance(b, Text) else b.name
        for b in blocks
        if isinstance(b, Text | Heading | TableBlock)
    ]


EMPTY = ("effects", "places", "absences", "not_testable", "confirmation_errors", "notes", "agents")


def test_page_without_findings(traffic: Case) -> None:
    empty: dict[str, Any] = {name: [] for name in EMPTY}
    words = words_of(traffic, verdict="none", unknown=None, **empty)
    assert words.count("No sequence has a fault.") == 1
    tables = {word for word in words if re.fullmatch("[a-z_]+", word)}
    assert tables == {"gap", "parameters", "screen", "clusters"}


def test_hypotheses_on_page(traffic: Case) -> None:
    d = traffic.found.diagnosis
    changes = {
        "effects": [],
        "verdict": "none",
        "hypotheses": d.effects,
        "confirmation": Confirmation(0.4, 5, False, "the errors do not fall"),
    }
    words = words_of(traffic, **changes)
    assert words[words.index("hypotheses") - 1] == "Reason: the errors do not fall."
    assert "screen" in words_of(traffic, effects=[], verdict="not_testable")


def test_compared_and_refused_laws_on_page(traffic: Case) -> None:
    best = ComparedLaw("idm", 5, 1.0, 0.0, 1.0, {"idm.T": (1.2, "s")})
    diagnosed = ComparedLaw("stand-in", 2, 2.0, 0.3, 0.001, {})
    laws = Laws([best, diagnosed], {"newell": "a map"}, 3, nearest="idm")
    words = words_of(traffic, laws=laws)
    assert "idm fits best" in words[0]
    place = words.index("laws")
    assert "Best law: idm." in words[place - 1]
    assert "newell (a map)" in words[place + 1]


def test_limits_of_model_on_page(traffic: Case) -> None:
    options = {"name": "n2", "term": "network_speed", "hidden": 2, "v0": 30.0, "box": None}
    network = build_model({**options, "leader": "measured"})
    differ = deepcopy(traffic.found.extended)
    people = {traffic.inputs.sequences[0].name: [0.1, 0.0, -0.1, 0.0]}
    add_effects(differ, [{"name": "driver_heterogeneity", "people": people}])
    words = "\n".join(words_of(traffic, base=network, extended=differ))
    assert "**The model is a network.**" in words
    assert "weights of the network are stored in the checkpoint only" in words
    assert "driver_heterogeneity acts only on agents of the exploration sequences" in words


def test_player_opens_on_median_error(traffic: Case) -> None:
    outcome = deepcopy(traffic.found)
    ((simulation, _), *_) = outcome.simulated
    assert simulation is not None
    errors = [4.0, 9.0, 1.0, float("inf"), 16.0]  # diverged simulations are not shown
    outcome.simulated, rows = [], []
    for error in errors:
        sequence = replace(simulation.sequence, name=f"s{error:g}")
        moved = replace(simulation, sequence=sequence, x=sequence.x + np.sqrt(error))
        outcome.simulated.append((moved, moved))
        rows.append({"name": sequence.name, "before": error, "after": error})
    outcome.diagnosis = replace(outcome.diagnosis, confirmation_errors=rows)
    shown = scenes(outcome)
    assert [scene.sequence.name for scene in shown] == ["s16", "s9", "s4", "s1"]
    assert shown[typical(shown)].sequence.name == "s4"


def coefficients(unit: str, **values: float) -> dict[str, Coefficient]:
    return {name: Coefficient(value, value, value, unit) for name, value in values.items()}


@pytest.mark.parametrize(
    ("place", "shaded"),
    [
        (coefficients("m", a=1.0, b=2.0), {"x": (1.0, 2.0)}),
        (coefficients("s", a=3.0, b=9.0), {"t": (3.0, 9.0)}),
        (coefficients("m", A_o=1.0, B_o=0.6, x_o=-1.0, y_o=2.0), {"circle": (-1.0, 2.0, 0.6)}),
    ],
)
def test_place_of_effect_is_shaded(
    traffic: Case, place: dict[str, Coefficient], shaded: dict[str, Any]
) -> None:
    d = traffic.found.diagnosis
    (effect,) = d.effects
    (zone,) = zones(replace(d, effects=[replace(effect, coefficients=place)]))
    assert zone == Zone("speed_zone", **shaded)


def test_largest_deviation_is_shaded_without_effect(traffic: Case) -> None:
    d = traffic.found.diagnosis
    assert zones(replace(d, effects=[])) == [Zone("largest deviation", x=ZONE)]
    assert zones(replace(d, effects=[], places=[])) == []
