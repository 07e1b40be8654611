"""Formulas in docs/method.md."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
import yaml

from nnode.model import build_model
from nnode.model.effects import CATALOGUE
from nnode.model.laws import CAR_FOLLOWING_LAWS
from nnode.model.operations import FUNCTIONS
from nnode.simulation.kernels import source

METHOD = (
    Path("docs/method.md").read_text("utf-8").split("## A law is one formula")[1].split("\n## ")[0]
)


def test_law_in_a_file() -> None:
    (text,) = re.findall(r"```yaml\n(.*?)```", METHOD, re.S)
    options = {k: v for k, v in yaml.safe_load(text).items() if k != "defaults"}
    model = build_model({"term": "formula", "effects": [], **options})
    values = {name: float(value) for name, (value, _) in model.physical().items()}
    assert values == pytest.approx({"saturation.v0": 30.0, "saturation.reach": 12.0})
    gap = torch.tensor([6.0, 12.0], dtype=torch.float64)
    speed = model.terms[0].speed(gap).detach()
    torch.testing.assert_close(speed, 30 * (1 - torch.exp(-gap / 12)), rtol=1e-14, atol=0)
    assert "saturation.reach" in source(model)


def test_laws_on_the_command_line() -> None:
    laws = re.findall(r"'model\.law=(\{parameters.*\})'", METHOD)
    assert len(laws) == 2
    options = {"term": "formula", "name": "mine", "leader": "measured"}
    lane, people = (build_model({**options, "law": yaml.safe_load(text)}) for text in laws)
    assert (lane.domain, people.domain) == ("traffic", "crowd")
    assert list(lane.physical()) == ["mine.v0", "mine.L"]
    assert list(people.physical()) == ["mine.A", "mine.B", "mine.tau"]


@pytest.mark.parametrize("name", CAR_FOLLOWING_LAWS)
def test_laws_are_documented_with_their_parameters(name: str) -> None:
    rows = [line.split("|") for line in METHOD.splitlines() if line.startswith("| `")]
    (row,) = [row for row in rows if f"`{name}`" in row[1]]
    shown = row[3].replace("κ", "kappa").replace("λ", "lam")
    names = {part.strip() for part in shown.split(",")}
    assert names == (set(CAR_FOLLOWING_LAWS[name]["parameters"]) or {"weights"})
    assert f"`{name}`" in Path("README.md").read_text("utf-8")


def test_effects_on_accelerations_are_documented() -> None:
    table = METHOD.split("what becomes of an acceleration W")[1].split("\n\n")[0]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    names = {name for row in rows for name in re.findall(r"`(\w+)`", row)}
    assert names == {e.name for e in CATALOGUE.of("traffic", every=True) if 2 in e.rules}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_are_documented(name: str) -> None:
    assert name in METHOD
