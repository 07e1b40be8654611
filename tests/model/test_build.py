"""Models from options: start values, precision, seeds, and errors."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import pytest
import torch
from scipy import stats

from nnode.errors import ConfigError
from nnode.model import Crowd, System, Traffic, build_model
from nnode.model.options import (
    LawOptions,
    NetworkForceOptions,
    NetworkSpeedOptions,
    SocialForceOptions,
)


def options(kind: type, term: str, **changes: Any) -> dict[str, Any]:
    return {**asdict(kind(name=term, term=term)), **changes}


ALL = [
    options(LawOptions, "lin"),
    options(LawOptions, "log"),
    options(NetworkSpeedOptions, "network_speed"),
    options(SocialForceOptions, "social_force"),
    options(NetworkForceOptions, "network_force"),
]


def flat(model: System) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in model.parameters()])


@pytest.mark.parametrize("term", ["lin", "log"])
def test_laws_start_where_the_paper_starts(term: str) -> None:
    model = build_model(options(LawOptions, term))
    assert isinstance(model, Traffic)
    physical = {name: (value.item(), unit) for name, (value, unit) in model.physical().items()}
    assert physical == {f"{term}.v0": (30.0, "m/s"), f"{term}.L": (5.0, "m")}
    assert model.leader == "constant"


@pytest.mark.parametrize(("hidden", "weights"), [(2, 7), (4, 13), (10, 31)])
def test_networks_start_at_30_metres_per_second(hidden: int, weights: int) -> None:
    model = build_model(options(NetworkSpeedOptions, "network_speed", hidden=hidden))
    assert model.physical()["network_speed.v0"][0].item() == 30.0
    assert flat(model).numel() == 1 + weights


def test_two_networks_of_30_weights_move_the_crowd() -> None:
    model = build_model(options(NetworkForceOptions, "network_force"))
    assert isinstance(model, Crowd)
    assert flat(model).numel() == 60


def test_people_act_on_themselves_where_the_options_say_so() -> None:
    chosen = options(NetworkForceOptions, "network_force")
    printed = build_model({**chosen, "self_interaction": True}).find_law("network_force")
    # checkpoints of earlier versions have no such option
    chosen.pop("self_interaction")
    earlier = build_model(chosen).find_law("network_force")
    assert printed is not None
    assert earlier is not None
    assert (printed.self_interaction, earlier.self_interaction) == (True, False)


def test_social_force_starts_uniform_on_0_to_50() -> None:
    drawn = [build_model(options(SocialForceOptions, "social_force"), seed=s) for s in range(300)]
    for name in ("A", "k", "kappa"):
        sample = [model.physical()[f"social_force.{name}"][0].item() for model in drawn]
        assert stats.kstest(sample, stats.uniform(0, 50).cdf).pvalue > 1e-3


def test_given_start_values_leave_the_others_draws_alone() -> None:
    free = build_model(options(SocialForceOptions, "social_force"), seed=4).physical()
    given = build_model(options(SocialForceOptions, "social_force", A=0.0044), seed=4).physical()
    assert given["social_force.A"][0].item() == 0.0044
    assert torch.equal(given["social_force.k"][0], free["social_force.k"][0])
    assert torch.equal(given["social_force.kappa"][0], free["social_force.kappa"][0])


@pytest.mark.parametrize("choice", ALL, ids=lambda o: o["term"])
def test_a_seed_means_the_same_start_in_every_precision(choice: dict[str, Any]) -> None:
    double = build_model(choice, seed=7)
    single = build_model(choice, seed=7, dtype=torch.float32)
    assert {p.dtype for p in double.parameters()} == {torch.float64}
    assert {p.dtype for p in single.parameters()} == {torch.float32}
    assert torch.equal(flat(double).float(), flat(single))


@pytest.mark.parametrize("choice", ALL[2:], ids=lambda o: o["term"])
def test_another_seed_means_another_start(choice: dict[str, Any]) -> None:
    assert not torch.equal(flat(build_model(choice, seed=7)), flat(build_model(choice, seed=8)))


@pytest.mark.parametrize(("start", "length"), [(4.7, 4.7), (1.0, 2.0)])
def test_a_built_law_keeps_the_digits_of_admissible_start_values(
    start: float, length: float
) -> None:
    law = build_model(options(LawOptions, "log", L=start))
    assert law.physical()["log.L"][0].item() == length


def test_a_built_network_is_within_its_box() -> None:
    boxed = build_model(options(NetworkSpeedOptions, "network_speed", box=0.1))
    assert flat(boxed)[1:].abs().max().item() == 0.1


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        (options(NetworkSpeedOptions, "network_speed", hidden=0), "at least two layers"),
        (options(NetworkSpeedOptions, "network_speed", box=-1.0), "low <= high"),
        (options(SocialForceOptions, "social_force", tau=0.0), "tau"),
        (options(SocialForceOptions, "social_force", B=-1.0), "B=-1"),
        (options(NetworkForceOptions, "network_force", mass=0.0), "mass"),
        (options(NetworkForceOptions, "network_force", wall_spacing=0.0), "wall_spacing"),
        (
            options(SocialForceOptions, "sozial_force"),
            r"model\.term=sozial_force.*did you mean social_force",
        ),
        *(
            (options(LawOptions, "lin", v0=v0), rf"model\.v0={v0}")
            for v0 in (0.0, -3.0, float("nan"))
        ),
    ],
    ids=lambda v: v if isinstance(v, str) else "",
)
def test_impossible_values_are_a_config_error(choice: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        build_model(choice)


def test_v0_of_a_network_with_a_measured_leader_is_idle() -> None:
    options = {"term": "network_speed", "v0": 30.0, "hidden": 2, "box": None}
    free = build_model({**options, "leader": "constant"})
    idle = build_model({**options, "leader": "measured"})
    assert list(free.physical()) == ["network_speed.v0"]
    assert list(idle.physical()) == []
    trained = [name for name, p in idle.named_parameters() if p.requires_grad]
    assert trained
    assert not any(name.endswith("v0") for name in trained)
