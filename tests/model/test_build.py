"""Models from options: start values, precision, seeds, errors and names of parameters."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import pytest
import torch
from scipy import stats

from nnode.errors import ConfigError
from nnode.model import Crowd, System, build_model, make_law
from nnode.model.effects.lane import SpeedZone
from nnode.model.options import (
    LawOptions,
    NetworkForceOptions,
    NetworkSpeedOptions,
    SocialForceOptions,
)
from nnode.model.term import short_names


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
def test_start_values_of_laws(term: str) -> None:
    model = build_model(options(LawOptions, term))
    physical = {name: (value.item(), unit) for name, (value, unit) in model.physical().items()}
    assert physical == {f"{term}.v0": (30.0, "m/s"), f"{term}.L": (5.0, "m")}
    assert model.leader == "constant"


@pytest.mark.parametrize(("hidden", "weights"), [(2, 7), (4, 13), (10, 31)])
def test_network_speed_parameters(hidden: int, weights: int) -> None:
    model = build_model(options(NetworkSpeedOptions, "network_speed", hidden=hidden))
    assert model.physical()["network_speed.v0"][0].item() == 30.0
    assert flat(model).numel() == 1 + weights


def test_network_force_has_two_networks_of_30_weights() -> None:
    model = build_model(options(NetworkForceOptions, "network_force"))
    assert isinstance(model, Crowd)
    assert flat(model).numel() == 60


def test_self_interaction_option() -> None:
    chosen = options(NetworkForceOptions, "network_force", self_interaction=True)
    assert build_model(chosen).find_law("network_force").self_interaction
    del chosen["self_interaction"]  # checkpoints of earlier versions do not have this option
    assert not build_model(chosen).find_law("network_force").self_interaction


def test_social_force_starts_uniform_on_0_to_50() -> None:
    drawn = [build_model(options(SocialForceOptions, "social_force"), seed=s) for s in range(300)]
    for name in ("A", "k", "kappa"):
        sample = [model.physical()[f"social_force.{name}"][0].item() for model in drawn]
        assert stats.kstest(sample, stats.uniform(0, 50).cdf).pvalue > 1e-3


def test_given_start_value_does_not_change_the_others() -> None:
    free = build_model(options(SocialForceOptions, "social_force"), seed=4).physical()
    given = build_model(options(SocialForceOptions, "social_force", A=0.0044), seed=4).physical()
    assert given["social_force.A"][0].item() == 0.0044
    assert torch.equal(given["social_force.k"][0], free["social_force.k"][0])
    assert torch.equal(given["social_force.kappa"][0], free["social_force.kappa"][0])


@pytest.mark.parametrize("choice", ALL, ids=lambda o: o["term"])
def test_seed_gives_equal_starts_in_both_precisions(choice: dict[str, Any]) -> None:
    double = build_model(choice, seed=7)
    single = build_model(choice, seed=7, dtype=torch.float32)
    assert {p.dtype for p in double.parameters()} == {torch.float64}
    assert {p.dtype for p in single.parameters()} == {torch.float32}
    assert torch.equal(flat(double).float(), flat(single))


@pytest.mark.parametrize("choice", ALL[2:], ids=lambda o: o["term"])
def test_seeds_give_different_starts(choice: dict[str, Any]) -> None:
    assert not torch.equal(flat(build_model(choice, seed=7)), flat(build_model(choice, seed=8)))


@pytest.mark.parametrize(("start", "length"), [(4.7, 4.7), (1.0, 2.0)])
def test_start_values_are_projected_onto_bounds(start: float, length: float) -> None:
    law = build_model(options(LawOptions, "log", L=start))
    assert law.physical()["log.L"][0].item() == length


def test_network_weights_are_within_their_box() -> None:
    boxed = build_model(options(NetworkSpeedOptions, "network_speed", box=0.1))
    assert flat(boxed)[1:].abs().max().item() == 0.1


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        (options(NetworkSpeedOptions, "network_speed", hidden=0), "at least two layers"),
        (options(NetworkSpeedOptions, "network_speed", box=-1.0), "low <= high"),
        (options(SocialForceOptions, "social_force", tau=0.0), "tau"),
        (options(SocialForceOptions, "social_force", B=-1.0), "B=-1"),
        (options(SocialForceOptions, "social_force", r=-0.1), r"\br=-0\.1"),
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
def test_invalid_values(choice: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build_model(choice)


def test_v0_of_a_network_with_a_measured_leader_is_not_trained() -> None:
    chosen = options(NetworkSpeedOptions, "network_speed", leader="constant")
    assert list(build_model(chosen).physical()) == ["network_speed.v0"]
    model = build_model({**chosen, "leader": "measured"})
    assert list(model.physical()) == []
    trained = [name for name, p in model.named_parameters() if p.requires_grad]
    assert trained
    assert not any(name.endswith("v0") for name in trained)


# -- names of parameters -------------------------------------------------------------------------


def with_effects(*effects: str) -> System:
    chosen = [{"name": name, "alpha": 0.7} for name in effects]
    return build_model(options(LawOptions, "lin", effects=chosen))


@pytest.mark.parametrize("others", [(), ("speed_zone",)])
def test_names_do_not_depend_on_other_terms(others: tuple[str, ...]) -> None:
    physical = with_effects(*others, "speed_period").physical()
    assert float(physical["speed_period.alpha"][0]) == 0.7
    assert physical["lin.v0"][1] == "m/s"
    assert len(physical) == 2 + 3 * (1 + len(others))


def test_two_terms_of_one_name() -> None:
    two = System([make_law("lin", v0=30.0), SpeedZone(alpha=0.7), SpeedZone(alpha=0.9)])
    physical = {name: float(value) for name, (value, _) in two.physical().items()}
    assert (physical["speed_zone.alpha"], physical["speed_zone_2.alpha"]) == (0.7, 0.9)


def test_printed_names_of_unique_parameters_are_short() -> None:
    names = list(with_effects("speed_zone", "speed_period").physical())
    assert short_names(names) == {name: name for name in names} | {"lin.v0": "v0", "lin.L": "L"}
    assert "v0=30 m/s" in repr(with_effects())
    assert "speed_zone.alpha=0.7 1" in repr(with_effects("speed_zone", "speed_period"))
