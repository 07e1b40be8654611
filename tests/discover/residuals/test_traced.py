"""Recorded graphs do what the functions do that they were recorded from."""

import gc
import os
from pathlib import Path

import pytest
import torch
from torch import Tensor

from nnode.discover.residuals.traced import recorded


def curved(x: Tensor, scale: Tensor) -> Tensor:
    parts = torch.stack([x.sin(), x.clamp(min=0)]).unbind(0)
    total: Tensor = (scale * parts[0] + parts[1]).cumsum(-1)
    return total


def in_runs(x: Tensor, scale: Tensor) -> Tensor:
    found: Tensor = torch.func.vmap(curved, in_dims=(None, 0))(x, scale)
    return found


@pytest.mark.parametrize("function", [curved, in_runs])
def test_a_graph_gives_the_same_bits(function):
    x, scale = torch.linspace(-2, 3, 7).double(), torch.tensor([1.0]).double()
    graph = recorded(function, [x, scale])
    assert graph is not function
    for factor in (1.0, -0.7, 12.0):
        expected = function(factor * x, scale + factor)
        assert torch.equal(graph(factor * x, scale + factor), expected)


def test_the_value_of_a_tensor_cannot_be_recorded():
    def function(x: Tensor) -> Tensor:
        return x if float(x.sum()) > 0 else -x

    assert recorded(function, [torch.ones(2)]) is function


def test_what_depends_on_more_than_its_inputs_is_run_as_it_is():
    calls = []

    def function(x: Tensor) -> Tensor:
        calls.append(len(calls))
        return x * len(calls)

    graph = recorded(function, [torch.ones(2)])
    assert graph is function


def test_numbers_that_are_none_do_not_matter():
    graph = recorded(torch.log, [torch.tensor([-1.0, 0.0, 1.0])])
    found = graph(torch.tensor([-2.0, 1.0, 0.0]))
    assert found.isnan().tolist() == [True, False, False]
    assert found[1:].tolist() == [0.0, -torch.inf]


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs Linux's count of pages")
def test_a_graph_is_freed_with_its_last_user():
    """What a graph holds is in memory as long as the graph, and no longer."""

    def resident() -> float:
        gc.collect()
        return (
            int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
        )

    x = torch.ones(500_000).double()

    def once() -> None:
        held = torch.rand(500_000).double()  # 4 MB
        assert recorded(lambda y: (y * held).sin(), [x])(x).shape == x.shape

    once()
    before = resident()
    for _ in range(50):
        once()
    assert resident() - before < 100  # of 200 MB
