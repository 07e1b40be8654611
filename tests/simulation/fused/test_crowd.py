"""Compiled crowd models against torchdiffeq's discrete gradient in float64."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from nnode.data.sequence import Sequence, collate
from nnode.errors import ConfigError, SimulationError
from nnode.model import Crowd, Law, Traffic, make_law
from nnode.model.effects import CATALOGUE
from nnode.model.network import FeedForward
from nnode.simulation import FusedSolver
from nnode.simulation.kernels import crowds as compiled
from nnode.simulation.kernels.crowds import SIZE, CrowdSource
from tests import builders
from tests.builders import social_forces
from tests.simulation.fused.compare import compare, gradient, single
from tests.simulation.fused.test_fallback import Sway
from tests.simulation.fused.test_neighbours import Weaker
from tests.simulation.kernels.test_lane_code import PACKED, platform
from tests.simulation.scenes import crowd, network_force

pytestmark = pytest.mark.usefixtures("without_fallback")

DT = 0.05


MODELS = {
    "sf": lambda: social_forces(B=0.1),
    "nn": lambda: [make_law("relaxation"), network_force()],
    "nn_self": lambda: [make_law("relaxation"), network_force(self_interaction=True)],
}


@pytest.fixture
def people() -> list[Sequence]:
    """Crowds of one to eight people with different durations, and zero to two walls."""
    return [
        crowd(4, samples=4, name="a"),
        crowd(2, samples=3, name="b"),
        crowd(7, samples=5, name="c"),
        crowd(1, samples=2, name="d"),
        crowd(8, samples=5, name="e", apart=0.3),
    ]


@pytest.mark.thorough  # each precision has its own compilation
@pytest.mark.parametrize("name", ["sf", "nn"])
def test_single_precision(name: str, people: list[Sequence]) -> None:
    model = Crowd(MODELS[name]()).to(torch.float32).to(torch.float64)
    close = {"limit": 1e-4, "rtol": 1e-6, "atol": 1e-6}
    compare(model, single(people), DT, FusedSolver(DT), single_precision=True, **close)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["sf", "nn"])
def test_many_blocks_and_threads(name: str) -> None:
    # several blocks, and rows that are cut into pieces
    items = [crowd(3 + i % 5, samples=3, name=f"m{i}") for i in range(150)]
    solvers = [FusedSolver(DT, threads) for threads in (1, 2, 3)]
    compare(Crowd(MODELS[name]()), single(items), DT, *solvers)


@pytest.mark.parametrize("name", ["sf", "nn"])
def test_rows_longer_than_a_piece(name: str) -> None:
    x = np.tile(np.random.default_rng(5).uniform(0, 25, (SIZE + 21, 2)), (2, 1, 1))
    x[1] += 0.1
    item = builders.people(x, 0.1, walls=np.array([[-1.0, 0.0, 0.0, 0.0]]))
    compare(Crowd(MODELS[name]()), single([item]), DT, FusedSolver(DT, cutoff_error=0))


@pytest.mark.parametrize("name", ["sf", "nn"])
def test_far_from_the_origin(name: str) -> None:
    item, far = crowd(6, samples=4), np.array([3000.0, -800.0])
    goals, walls = item.destination + far, item.walls + np.tile(far, 2)
    moved = replace(item, x=item.x + far, destination=goals, walls=walls)
    compare(Crowd(MODELS[name]()), collate([moved]), DT, FusedSolver(DT), limit=1e-9)


def test_people_in_one_place() -> None:
    item = crowd(3, samples=3)
    item.x[:, 1] = item.x[:, 0]
    compare(Crowd(MODELS["sf"]()), collate([item]), DT, FusedSolver(DT))


def test_saturated_neurons(people: list[Sequence]) -> None:
    # PyTorch's softplus has a corner at 20
    model = Crowd(MODELS["nn"]())
    with torch.no_grad():
        for term in model.terms:
            if isinstance(term, Law) and term.entry == "network_force":
                term.pair.layers[0].bias[:2] = torch.tensor([25.0, -40.0])
                term.wall.layers[0].weight.mul_(30.0)
    compare(model, single(people), DT, FusedSolver(DT))


@pytest.mark.parametrize(
    ("name", "options"),
    [
        pytest.param("nn", {}, id="dense"),
        pytest.param("sf", {"cutoff": 30.0}, marks=pytest.mark.thorough, id="lists"),
    ],
)
def test_padding_stands_still(name: str, options: dict[str, float], people: list[Sequence]) -> None:
    batch = single(people)
    x0 = batch.x.clone().requires_grad_()
    moving = replace(batch, x=x0)
    model = Crowd(MODELS[name]())
    law = compiled.supports(model, moving)
    x = compiled.simulate(model, law, moving, 2, **options)[..., :2]
    padding = ~batch.agent
    assert padding.any()
    assert (x[:, padding] == batch.x[0, padding]).all()
    x[:, padding].sum().backward()
    assert (x0.grad[0, padding] == len(x)).all()
    assert not x0.grad[0, ~padding].any()


@pytest.mark.parametrize("name", ["sf", "nn"])
def test_states_without_gradient(name: str, people: list[Sequence]) -> None:
    batch, model, solver = collate(people), Crowd(MODELS[name]()), FusedSolver(DT)
    with torch.no_grad():
        x = solver(model, batch).x
    assert not x.requires_grad
    torch.testing.assert_close(x, solver(model, batch).x, rtol=1e-14, atol=1e-14)


def test_divergence_is_reported() -> None:
    items = [crowd(1, name="alone"), crowd(3, name="crushed", apart=0.1)]
    model = Crowd(social_forces(A=1e300, k=0.0, kappa=0.0, B=1e-4))
    with pytest.raises(SimulationError, match="crushed blew up"):
        FusedSolver(DT)(model, collate(items))


def test_one_compilation_for_all_shapes(people: list[Sequence]) -> None:
    # another layout of arrays would need another compilation
    for items in (people, people[3:4], [crowd(2, samples=2)], [crowd(3)] * 70):
        gradient(Crowd(MODELS["sf"]()), FusedSolver(DT), collate(items))
    module = compiled.compiled(CrowdSource(compiled.supports(Crowd(MODELS["sf"]()))))
    for function in (module.forward, module.backward):
        assert 1 <= len(function.signatures) <= 2  # two precisions


def test_supported_models(people: list[Sequence]) -> None:
    batch, deep, measured = collate(people), Crowd(MODELS["nn"]()), Crowd(MODELS["sf"]())
    deep.find_law("network_force").pair = FeedForward((4, 3, 3, 2))
    measured.neighbours = "measured"
    assert compiled.supports(Crowd(MODELS["sf"]()), batch)
    assert compiled.supports(deep)
    for model in (
        Traffic([make_law("lin")]),
        Crowd([make_law("relaxation")]),
        Crowd([make_law("relaxation"), Weaker(entry="social_force")]),
        Crowd([*MODELS["sf"](), Sway()]),
        measured,
        # all sums have the same range, which includes oneself only for networks
        Crowd([*MODELS["nn_self"](), CATALOGUE.effects["alignment"](c=0.2)]),
    ):
        assert not compiled.supports(model)
    batch.destination.requires_grad_()
    assert not compiled.supports(Crowd(MODELS["sf"]()), batch)


def test_cutoff_below_the_contact_distance(people: list[Sequence]) -> None:
    message = r"solver\.cutoff=0\.4 m must be larger than 0\.5 m, the distance of people who touch"
    with pytest.raises(ConfigError, match=message):
        FusedSolver(DT, cutoff=0.4)(Crowd(MODELS["sf"]()), collate(people))


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["sf", "nn"])
def test_loops_are_vector_code(name: str) -> None:
    if platform.machine() not in PACKED:
        pytest.skip("unknown instruction set")
    source = CrowdSource(compiled.supports(Crowd(MODELS[name]())))
    module = compiled.compiled(source)
    for kind in (np.float64, np.float32):
        buffer, q = np.ones(module.ROWS * SIZE, kind), np.ones(len(source.uniform), kind)
        names = ("law_others_vjp", "law_points_vjp", "slopes_others", "slopes_points")
        loops = [getattr(module, name) for name in names if hasattr(module, name)]
        assert len(loops) == 2
        for function in loops:
            if function.__name__.startswith("law"):
                function(buffer, 0, 32, q, kind(0), kind(1), 0, np.zeros(len(q)))
            else:
                function(buffer, *(np.ones(32, kind) for _ in range(3)), 32, kind(1))
            text = function.inspect_asm(function.signatures[-1])
            assert re.findall(PACKED[platform.machine()], text), function.__name__


#: Effects on each part of a formula.
EFFECTS = {
    "sums": {
        "alignment": {"c": 0.4},
        "side_preference": {"c": 0.9},
        "density_slowdown": {"c": 0.3},
    },
    "force": {"anticipation": {"T_a": 0.4}, "field_of_view": {"lambda_": 0.3}, "drift": {}},
    "walls": {
        "wall_repulsion": {"A_w": 0.8, "B_w": 0.3},
        "group_cohesion": {"c": 0.5},
        "walker_heterogeneity": {"people": {"c": [0.1, -0.3, 0.2, 0.4, 0.0, 0.1, 0.3]}},
    },
}


def with_effects(base: str, *chosen: str) -> Crowd:
    """A model with the effects on some parts."""
    effects = {name: values for part in chosen for name, values in EFFECTS[part].items()}
    return Crowd([*MODELS[base](), *(CATALOGUE.effects[n](**v) for n, v in effects.items())])


def in_groups(people: list[Sequence]) -> list[Sequence]:
    names = ("g", "", "h", "g", "h", "g", "i", "h")
    return [replace(item, group=names[: item.x.shape[1]]) for item in people]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("base", "chosen"), [("sf", ("sums", "force", "walls")), ("nn", ("force",))], ids=str
)
def test_effects(base: str, chosen: tuple[str, ...], people: list[Sequence]) -> None:
    compare(with_effects(base, *chosen), single(in_groups(people)), DT, FusedSolver(DT, 2))


@pytest.mark.thorough
def test_effects_with_a_cutoff(people: list[Sequence]) -> None:
    model, batch = with_effects("sf", "walls"), single(in_groups(people))
    compare(model, batch, DT, FusedSolver(DT, cutoff=50.0))
    with torch.no_grad():
        large, small = (FusedSolver(DT, cutoff=c)(model, batch).x[-1] for c in (50.0, 0.6))
    assert (large - small)[batch.valid[-1]].abs().max() > 1e-6
