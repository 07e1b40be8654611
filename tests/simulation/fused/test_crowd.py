"""Compiled crowd models against torchdiffeq's discrete gradient in float64."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from nnode.data.sequence import Sequence, collate
from nnode.errors import ConfigError, SimulationError
from nnode.model import Crowd, InteractionForce, Law, Traffic, make_law
from nnode.model.effects import CATALOGUE
from nnode.model.network import FeedForward
from nnode.simulation import FusedSolver, fused
from nnode.simulation.kernels import crowds as compiled
from nnode.simulation.kernels.crowds import SIZE, CrowdSource
from tests import builders
from tests.builders import social_forces
from tests.simulation.fused.compare import compare, gradient, single
from tests.simulation.fused.test_fallback import Sway
from tests.simulation.scenes import crowd

DT = 0.05


def network(hidden: int = 4, **options: object) -> Law:
    return make_law(
        "network_force", hidden=hidden, generator=torch.Generator().manual_seed(3), **options
    )  # type: ignore[arg-type]


MODELS = {
    "sf": lambda: social_forces(B=0.1),
    "nn": lambda: [make_law("relaxation"), network()],
    "nn_self": lambda: [make_law("relaxation"), network(self_interaction=True)],
}


@pytest.fixture(autouse=True)
def compiled_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """No test here may pass because the fallback is right."""
    monkeypatch.delattr(fused, "TorchdiffeqSolver")


@pytest.fixture
def people() -> list[Sequence]:
    """Crowds of one to eight people, of different duration, with none, one and two walls."""
    return [
        crowd(4, samples=4, name="a"),
        crowd(2, samples=3, name="b"),
        crowd(7, samples=5, name="c"),
        crowd(1, samples=2, name="d"),
        crowd(8, samples=5, name="e", apart=0.3),
    ]


@pytest.mark.thorough  # each precision is compiled for
@pytest.mark.parametrize("name", ["sf", "nn"])
def test_single_precision(name: str, people: list[Sequence]) -> None:
    model = Crowd(MODELS[name]()).to(torch.float32).to(torch.float64)
    close = {"limit": 1e-4, "rtol": 1e-6, "atol": 1e-6}
    compare(model, single(people), DT, FusedSolver(DT), single_precision=True, **close)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["sf", "nn"])
def test_many_blocks_and_threads(name: str) -> None:
    # more than fit into one block, and rows that are cut into pieces
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
    assert law is not None
    x = compiled.simulate(model, law, moving, 2, **options)[..., :2]
    padding = ~batch.agent
    assert padding.any()
    assert (x[:, padding] == batch.x[0, padding]).all()
    x[:, padding].sum().backward()
    assert x0.grad is not None
    assert (x0.grad[0, padding] == len(x)).all()
    assert not x0.grad[0, ~padding].any()


def test_without_gradient_nothing_changes(people: list[Sequence]) -> None:
    for name in ("sf", "nn"):
        batch, model = collate(people), Crowd(MODELS[name]())
        with torch.no_grad():
            x = FusedSolver(DT)(model, batch).x
        assert not x.requires_grad
        torch.testing.assert_close(x, FusedSolver(DT)(model, batch).x, rtol=1e-14, atol=1e-14)


def test_a_blow_up_is_reported() -> None:
    items = [crowd(1, name="alone"), crowd(3, name="crushed", apart=0.1)]
    model = Crowd(social_forces(A=1e300, k=0.0, kappa=0.0, B=1e-4))
    with pytest.raises(SimulationError, match="crushed blew up"):
        FusedSolver(DT)(model, collate(items))


def test_one_compilation_for_all_shapes(people: list[Sequence]) -> None:
    # arrays of another layout would be compiled for again, unnoticed but for the seconds
    for items in (people, people[3:4], [crowd(2, samples=2)], [crowd(3)] * 70):
        gradient(Crowd(MODELS["sf"]()), FusedSolver(DT), collate(items))
    law = compiled.supports(Crowd(MODELS["sf"]()))
    assert law is not None
    module = compiled.compiled(CrowdSource(law))
    for function in (module.forward, module.backward):
        assert 1 <= len(function.signatures) <= 2  # of two precisions


def test_what_is_covered(people: list[Sequence]) -> None:
    class Weaker(InteractionForce):
        def pair_force(self, dx: Tensor, dv: Tensor) -> Tensor:
            return 0.5 * super().pair_force(dx, dv)

    batch = collate(people)
    assert compiled.supports(Crowd(MODELS["sf"]()), batch)
    assert compiled.supports(Crowd(MODELS["nn"]()))
    assert not compiled.supports(Traffic([make_law("lin")]))
    assert not compiled.supports(Crowd([make_law("relaxation")]))
    assert not compiled.supports(Crowd([make_law("relaxation"), Weaker(entry="social_force")]))
    assert not compiled.supports(Crowd([*MODELS["sf"](), Sway()]))
    deep = Crowd(MODELS["nn"]())
    deep.find_law("network_force").pair = FeedForward((4, 3, 3, 2))
    assert compiled.supports(deep)
    alone = Crowd(MODELS["sf"]())
    alone.neighbours = "measured"
    assert not compiled.supports(alone)
    # what sums run over is one for all of them, and only networks' may be over oneself
    terms = [*MODELS["nn_self"](), CATALOGUE.effects["alignment"](c=0.2)]
    assert not compiled.supports(Crowd(terms))
    batch.destination.requires_grad_()
    assert not compiled.supports(Crowd(MODELS["sf"]()), batch)


def test_a_cutoff_that_leaves_out_contacts(people: list[Sequence]) -> None:
    message = r"solver\.cutoff=0\.4 m must be larger than 0\.5 m, the distance of people who touch"
    with pytest.raises(ConfigError, match=message):
        FusedSolver(DT, cutoff=0.4)(Crowd(MODELS["sf"]()), collate(people))


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["sf", "nn"])
def test_loops_are_vector_code(name: str) -> None:
    # losing this makes everything ten times slower and nothing else would tell
    from tests.simulation.kernels.test_lane_code import PACKED, platform

    if platform.machine() not in PACKED:
        pytest.skip("unknown instruction set")
    law = compiled.supports(Crowd(MODELS[name]()))
    assert law is not None
    source = CrowdSource(law)
    module = compiled.compiled(source)
    for kind in (np.float64, np.float32):
        buffer, q = np.ones(module.ROWS * SIZE, kind), np.ones(len(source.uniform), kind)
        loops = ("law_others_vjp", "law_points_vjp", "slopes_others", "slopes_points")
        divide = [getattr(module, name) for name in loops if hasattr(module, name)]
        assert len(divide) == 2
        for function in divide:
            if function.__name__.startswith("law"):
                function(buffer, 0, 32, q, kind(0), kind(1), 0, np.zeros(len(q)))
            else:
                function(buffer, *(np.ones(32, kind) for _ in range(3)), 32, kind(1))
            text = function.inspect_asm(function.signatures[-1])
            assert re.findall(PACKED[platform.machine()], text), function.__name__


#: What changes each part of a formula: sums over others, wall points and walls, inputs, clocks.
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
        "gait_sway": {"a": 0.3, "f": 1.0, "people": {"a": [0.1, 0.4, 0.2, 0.9]}},
        "walker_heterogeneity": {"people": {"c": [0.1, -0.3, 0.2, 0.4, 0.0, 0.1, 0.3]}},
    },
}


def with_effects(base: str, *chosen: str) -> Crowd:
    """A model, and the effects of some of the parts."""
    effects = {name: values for part in chosen for name, values in EFFECTS[part].items()}
    return Crowd([*MODELS[base](), *(CATALOGUE.effects[n](**v) for n, v in effects.items())])


def in_groups(people: list[Sequence]) -> list[Sequence]:
    names = ("g", "", "h", "g", "h", "g", "i", "h")
    return [replace(item, group=names[: item.x.shape[1]]) for item in people]


@pytest.mark.thorough  # many effects at once take long to compile
@pytest.mark.parametrize(
    ("base", "chosen"), [("sf", ("sums", "force", "walls")), ("nn", ("force",))], ids=str
)
def test_effects(base: str, chosen: tuple[str, ...], people: list[Sequence]) -> None:
    compare(with_effects(base, *chosen), single(in_groups(people)), DT, FusedSolver(DT, 2))


@pytest.mark.thorough
def test_effects_among_neighbours(people: list[Sequence]) -> None:
    model, batch = with_effects("sf", "walls"), single(in_groups(people))
    compare(model, batch, DT, FusedSolver(DT, cutoff=50.0))
    # one that leaves people out is another model
    with torch.no_grad():
        whole, near = (FusedSolver(DT, cutoff=c)(model, batch).x[-1] for c in (50.0, 0.6))
    assert (whole - near)[batch.valid[-1]].abs().max() > 1e-6
