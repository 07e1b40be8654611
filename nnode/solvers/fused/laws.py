"""What the fused solver has to know about a follow-the-leader law.

A law is a sum of small functions of the gap, all of one form and each with its own parameters:

    W(gap) = offset + sum over u of share(gap, q_u),        q_u = (q_u1, ..., q_um).

The linear and the logarithmic law are one share, a network is one share per hidden neuron. The
number of shares is free when the program runs, so that networks of every size use the same
compiled code.

Adding a law takes one call of :func:`register` with three functions in a module that can be
imported by name:

``share(gap, q_1, ..., q_m)``
    the value, m/s;
``pull(gap, weight, q_1, ..., q_m)``
    its derivatives with respect to gap, q_1, ..., q_m, each times ``weight``, as a tuple;
``pack(parameters)``
    from the term's parameters by name, each with a leading axis of R runs, to ``offset`` of
    shape (R,) and ``q`` of shape (R, shares, m), by differentiable operations of PyTorch.

``share`` and ``pull`` are compiled by Numba, without branches and with the functions of
:mod:`nnode.solvers.fused._math`, so that they become vector instructions. Write numbers as
``real(2, gap)``. Both must stay finite at a gap of 1 m, which stands in for the gap of
vehicles that follow nobody.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from nnode.models.term import Term
from nnode.models.traffic import SMALLEST_GAP, Linear, Logarithmic, NetworkSpeed
from nnode.solvers.fused._math import log, real, torch_softplus

__all__ = ["LawKernel", "kernel_of", "register"]

Pack = Callable[[Mapping[str, Tensor]], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class LawKernel:
    """How the fused solver evaluates and differentiates a law.

    Attributes:
        share, pull: see the module; plain Python functions, compiled when first used.
        pack: parameters to offset and shares.
        size: m, the number of parameters of a share.
    """

    share: Callable[..., Any]
    pull: Callable[..., Any]
    pack: Pack
    size: int


_KERNELS: dict[type[Term], LawKernel] = {}


def register(
    law: type[Term],
    share: Callable[..., Any],
    pull: Callable[..., Any],
    pack: Pack,
    size: int,
) -> None:
    """Tell the fused solver how to compute ``law``, a subclass of FollowTheLeader.

    Raises:
        ValueError: a function that cannot be imported by its name, or no parameter.
    """
    if size < 1:
        raise ValueError(f"a share of {law.__name__} needs at least one parameter, got {size}")
    for function in (share, pull):
        module = importlib.import_module(function.__module__)
        if function.__module__ == "__main__" or not hasattr(module, function.__name__):
            raise ValueError(
                f"{function.__qualname__} of {law.__name__} cannot be imported by name; define "
                "it at the top level of a module"
            )
    _KERNELS[law] = LawKernel(share, pull, pack, size)


def kernel_of(term: Term) -> LawKernel | None:
    """The kernel of a term; None for an unknown class, subclasses of known ones included."""
    return _KERNELS.get(type(term))


def _lin_share(gap: Any, v0: Any, length: Any) -> Any:
    return v0 - v0 * length / gap


def _lin_pull(gap: Any, weight: Any, v0: Any, length: Any) -> Any:
    inverse = real(1, gap) / gap
    filled = length * inverse
    return (
        weight * v0 * filled * inverse,
        weight - weight * filled,
        -weight * v0 * inverse,
    )


def _lin_pack(parameters: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
    v0 = parameters["v0"]
    return torch.zeros_like(v0), torch.stack([v0, parameters["L"]], -1)[:, None]


def _log_share(gap: Any, v0: Any, density: Any) -> Any:
    smallest = real(SMALLEST_GAP, gap)
    return v0 * log((smallest if gap < smallest else gap) * density)


def _log_pull(gap: Any, weight: Any, v0: Any, density: Any) -> Any:
    smallest = real(SMALLEST_GAP, gap)
    held = gap < smallest
    y = smallest if held else gap
    slope = weight * v0
    return (
        real(0, gap) if held else slope / y,
        weight * log(y * density),
        slope / density,
    )


def _log_pack(parameters: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
    v0 = parameters["v0"]
    # 1/L, so that no gap is divided
    return torch.zeros_like(v0), torch.stack([v0, 1 / parameters["L"]], -1)[:, None]


def _neuron_share(gap: Any, weight_in: Any, bias: Any, weight_out: Any) -> Any:
    value, _ = torch_softplus(weight_in * gap + bias)
    return weight_out * value


def _neuron_pull(gap: Any, weight: Any, weight_in: Any, bias: Any, weight_out: Any) -> Any:
    value, slope = torch_softplus(weight_in * gap + bias)
    back = weight * weight_out * slope
    return back * weight_in, back * gap, back, weight * value


def _network_pack(parameters: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
    first, second = "network.layers.0.", "network.layers.1."
    columns = [
        parameters[first + "weight"][:, :, 0],
        parameters[first + "bias"],
        parameters[second + "weight"][:, 0],
    ]
    return parameters[second + "bias"][:, 0], torch.stack(columns, -1)


register(Linear, _lin_share, _lin_pull, _lin_pack, 2)
register(Logarithmic, _log_share, _log_pull, _log_pack, 2)
register(NetworkSpeed, _neuron_share, _neuron_pull, _network_pack, 3)
