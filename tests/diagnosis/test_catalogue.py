"""The documentation of the catalogue and its example of a user-defined effect."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
import torch

from nnode.data.sequence import collate
from nnode.diagnosis.catalogue import MARKS, catalogue, main, written
from nnode.diagnosis.report.deviation import simulate
from nnode.errors import ConfigError
from nnode.model import build_model
from nnode.model.build import add_effects
from nnode.model.effects import CATALOGUE, own
from nnode.model.extend import effects_of
from tests.app.conftest import ROOT
from tests.builders import lane
from tests.diagnosis import stand_in

LAW = {"name": "lin", "term": "lin", "leader": "measured", "v0": 20.0, "L": 8.0, "L_min": 2.0}
DOCS = ROOT / "docs" / "discovery.md"


def test_docs_contain_catalogue() -> None:
    text = DOCS.read_text(encoding="utf-8")
    assert written(text, catalogue()) == text, f"run: python -m nnode.diagnosis.catalogue {DOCS}"


def test_rows_of_effects() -> None:
    rows = {line.split("`")[1]: line for line in catalogue().splitlines() if line.startswith("| `")}
    for effect in CATALOGUE.effects.values():
        if effect is stand_in.Wind or not effect.__module__.startswith("nnode."):
            assert effect.name not in rows
            assert f"`{effect.name}`" in catalogue(own=True)
            continue
        if not effect.searched_orders:
            assert effect.name not in rows
            continue
        assert effect.source.replace("|", "\\|") in rows[effect.name]
        for parameter in (*effect.strengths, *effect.settings):
            assert f"{parameter}: " in rows[effect.name]


def test_command_prints_and_writes(tmp_path, capsys) -> None:
    main([])
    assert "| `speed_zone` |" in capsys.readouterr().out
    path = tmp_path / "doc.md"
    path.write_text(f"before\n{MARKS[0]}\nold table\n{MARKS[1]}\nafter\n")
    main([str(path)])
    text = path.read_text()
    assert text.startswith(f"before\n{MARKS[0]}\n### Traffic\n")
    assert text.endswith(f"|\n{MARKS[1]}\nafter\n")
    assert "old table" not in text
    with pytest.raises(ConfigError, match="expected the lines"):
        written("no marks", "")


@pytest.fixture
def documented(tmp_path, monkeypatch):
    """The file of the docs' example, which is loaded into the catalogue."""
    blocks = re.findall(r"```python\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.DOTALL)
    (code,) = (block for block in blocks if "CATALOGUE.add" in block)
    assert len(code.strip().splitlines()) <= 30
    path = tmp_path / "rear_pressure.py"
    path.write_text(code)
    monkeypatch.setenv(own.VARIABLE, str(path))
    yield path
    CATALOGUE.effects.pop("rear_pressure", None)


def test_docs_example(documented) -> None:
    model = build_model({**LAW, "effects": [{"name": "rear_pressure", "c": 2.0}]})
    own.load_own()  # a second time
    (effect,) = effects_of(model)
    assert effect.name == "rear_pressure"
    sequence = lane(np.array([0.0, 20.0, 60.0]) + 3.2 * np.arange(3)[:, None])
    batch = collate([sequence])
    state = torch.tensor(0.0), model.initial(batch), model.scene(batch)
    rate = model(*state)[0, :, 0]
    # the last vehicle has no follower; the one ahead of it has one 20 m behind
    push = math.exp(-2.0)
    assert rate.tolist() == pytest.approx([20 * (1 - 8 / 20), 20 * (1 - 8 / 40) + 2 * push, 0.0])
    rate[1].backward()
    assert float(effect.c.grad) == pytest.approx(push)
    rows = torch.func.vmap(lambda c: torch.func.functional_call(model, {"terms.1.c": c}, state))(
        torch.tensor([0.0, 2.0], dtype=torch.float64)
    )
    assert rows[1, 0, 1, 0] == rate[1]
    assert simulate(model, [sequence])[0] is not None


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "there is no such file"),
        ("import nothing_of_this_name", "fails: ModuleNotFoundError"),
    ],
)
def test_invalid_file_of_effects(tmp_path, monkeypatch, content, message) -> None:
    path = tmp_path / "mine.py"
    if content is not None:
        path.write_text(content)
    monkeypatch.setenv(own.VARIABLE, str(path))
    with pytest.raises(ConfigError, match=message):
        add_effects(build_model(LAW), [{"name": "any"}])
