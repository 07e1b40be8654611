"""Functions of tensors as recorded graphs: small batches cost arithmetic instead of Python."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

#: A graph may differ by rounding from what it records, relative to the largest value.
CLOSE = 1e-9
#: Where a graph is checked beside its inputs: at the first number times them, plus the second.
ELSEWHERE = 1.01, 0.07


class _Tape(TorchDispatchMode):
    """Notes every operation on tensors, below transformations such as ``vmap``."""

    def __init__(self) -> None:
        super().__init__()
        self.steps: list[tuple[Any, Any, Any, Any]] = []

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        if func is torch.ops.aten._local_scalar_dense.default:
            raise RuntimeError("a step depends on the value of a tensor")
        found = func(*args, **(kwargs or {}))
        self.steps.append((func, tuple(args), kwargs or {}, found))
        return found

    def replayed(self, inputs: Sequence[Tensor], output: Tensor, values: Sequence[Tensor]) -> Any:
        """The output for other values of the inputs; other tensors stay what they were."""
        # the tape keeps all its tensors, so that none of them shares its address with another
        known = {id(one): value for one, value in zip(inputs, values, strict=True)}

        def now(value: Any) -> Any:
            return known.get(id(value), value) if isinstance(value, Tensor) else value

        for func, args, kwargs, found in self.steps:
            args, kwargs = tree_map(now, (args, kwargs))
            fresh = func(*args, **kwargs)
            for one, value in zip(tree_leaves(found), tree_leaves(fresh), strict=True):
                known[id(one)] = value
        return known[id(output)]


def recorded(function: Callable[..., Tensor], inputs: Sequence[Tensor]) -> Callable[..., Tensor]:
    """A function of tensors as a graph, for inputs of the same shapes; without gradients.

    What cannot be recorded, such as a step that depends on the value of a tensor, is left as it
    is.

    Args:
        function: of the inputs; it must not change them, and must not depend on chance.
        inputs: examples.
    """
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # this is a trial
        factor, more = ELSEWHERE
        other = [factor * value + more for value in inputs]
        # first, so that what the function keeps for later calls is no part of the graph
        known = function(*other)
        try:
            with _Tape() as tape:
                output = function(*inputs)
            graph = _graph(lambda *values: tape.replayed(inputs, output, values), tuple(inputs))
            same = _same(graph(*inputs), output) and _same(graph(*other), known)
        except (AttributeError, KeyError, RuntimeError, TypeError, ValueError):
            return function
    return graph if same else function


def _graph(function: Callable[..., Tensor], inputs: tuple[Tensor, ...]) -> Callable[..., Tensor]:
    """A function as TorchScript.

    What ``torch.jit.trace`` makes of a function is never freed, with all the tensors in it; this
    one is freed with its last user.
    """
    graph, _ = torch._C._create_graph_by_tracing(function, inputs, lambda value: "", True, False)
    found: Callable[..., Tensor] = torch._C._create_function_from_graph("recorded", graph)
    return found


def _same(one: Tensor, other: Tensor) -> bool:
    if one.shape != other.shape:
        return False
    finite = other[other.isfinite()]
    close = CLOSE * float(finite.abs().max()) if finite.numel() else 0.0
    return torch.allclose(one, other, rtol=0.0, atol=close, equal_nan=True)
