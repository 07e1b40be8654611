"""Laws as their files describe them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from torch import Tensor

import nnode.model.laws as laws
from nnode.data.sequence import collate
from nnode.errors import ConfigError
from nnode.model import Crowd, FollowTheLeader, InteractionForce, State, Traffic, make_law
from nnode.model.build import add_effects, build_model
from nnode.model.terms import REDUCED
from tests.model.following import rates
from tests.model.test_forces import people

FILES = sorted(Path(laws.__file__).parent.glob("*.yaml"))
#: All keys of an entry.
KEYS = {
    "about",
    "formula",
    "source",
    "rank",
    "model",
    "options",
    "parameters",
    "settings",
    "constants",
    "networks",
    "hidden",
    "step",
    "states",
    "delayed",
    "remembered",
    "where",
    "rate",
    "force",
    "drive",
    "variants",
    *REDUCED,
}


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_law_from_its_file(file: Path) -> None:
    entry = yaml.safe_load(file.read_text("utf-8"))
    assert set(entry) <= KEYS
    assert entry["about"].endswith(".")
    law = make_law(file.stem, generator=torch.Generator().manual_seed(0))
    assert (law.name, law.entry, law.source) == (file.stem, file.stem, entry["source"])
    assert law.scalars == list(entry["parameters"])
    assert law.dynamics().is_formula
    assert isinstance(law, InteractionForce) is ("force" in entry)


def test_entries_are_ordered_by_rank() -> None:
    ranks = [entry["rank"] for entry in laws.entries().values()]
    assert ranks == sorted(set(ranks))
    assert {file.stem for file in FILES} == set(laws.entries())


def test_new_law_needs_only_an_entry(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = {
        "about": "Exponential saturation.",
        "source": "none",
        "model": ["saturated"],
        "options": ["reach", "reach_min"],
        "parameters": {"v0": "30 m/s", "reach": {"value": "12 m", "low": "1 m"}},
        "rate": {"x": "v0*(1 - exp(-gap/reach))"},
    }
    entries = {**laws.entries(), "saturated": entry}
    for module in ("laws", "build"):
        monkeypatch.setattr(f"nnode.model.{module}.entries", lambda: entries)
    options = {"term": "saturated", "name": "new", "leader": "constant", "reach": 8.0}
    model = build_model({**options, "reach_min": 2.0})
    assert {k: float(v) for k, (v, _) in model.physical().items()} == {
        "saturated.v0": 30.0,
        "saturated.reach": 8.0,
    }
    assert model.bounds()["terms.0.reach"].low == 2.0
    assert model.formula is not None


@pytest.mark.parametrize(
    ("name", "options", "error"),
    [
        ("lin", {"tau": 1.0}, "the law lin has no option tau"),
        ("relaxation", {"tau": -1.0}, r"tau=-1\.0 must be positive"),
        ("network_speed", {"hidden": 0}, "at least two layers"),
    ],
)
def test_invalid_options(name: str, options: dict[str, Any], error: str) -> None:
    with pytest.raises(ValueError, match=error):
        make_law(name, **options)


class Halved(InteractionForce):
    """Half of the entry's force between people."""

    def pair_force(self, dx: Tensor, dv: Tensor) -> Tensor:
        return 0.5 * super().pair_force(dx, dv)


class Tanh(FollowTheLeader):
    name = "tanh"

    def speed(self, gap: Tensor) -> Tensor:
        return self.v0 * torch.tanh(gap / 10)


def test_effects_on_a_force_in_code() -> None:
    batch, change = collate([people(5, 1)]), []
    for kind in (InteractionForce, Halved):
        model = Crowd([make_law("relaxation"), kind(entry="social_force", A=2.0, k=3.0, kappa=1.0)])
        before = rates(model, batch)
        add_effects(model, [{"name": "anticipation", "T_a": 0.5}])
        change.append(rates(model, batch) - before)
    assert change[0].abs().max() > 1e-3
    torch.testing.assert_close(change[1], 0.5 * change[0], rtol=1e-12, atol=1e-14)


def test_law_in_code_has_a_formula_of_calls() -> None:
    model = Traffic([Tanh(20.0)])
    assert model.formula is not None
    assert not model.formula.is_formula
    gap = torch.tensor([3.0, 30.0], dtype=torch.float64)
    assert torch.equal(model.terms[0].speed(gap), 20 * torch.tanh(gap / 10))


def test_formula_of_speeds_cannot_be_mixed_with_code() -> None:
    law = make_law("idm")
    x = torch.zeros(1, 2, 1, dtype=torch.float64)
    with pytest.raises(ConfigError, match="cannot be mixed with terms that are code"):
        law(State(torch.zeros(()), x, None, None))
