"""Vectors in the plane."""

from __future__ import annotations

import torch
from torch import Tensor

from nnode.model.term import State
from nnode.model.terms import SMOOTHING


def velocity(state: State) -> Tensor:
    """``(B, N, 2)`` m/s.

    Raises:
        ValueError: the model is of first order.
    """
    if state.v is None:
        raise ValueError("a term of a second-order model needs velocities")
    return state.v


def norm(vector: Tensor) -> Tensor:
    """``(..., 2)`` to ``(...)``: Euclidean length with a finite gradient everywhere."""
    return torch.sqrt(dot(vector, vector) + SMOOTHING**2)


def dot(a: Tensor, b: Tensor) -> Tensor:
    """``(..., 2)`` twice to ``(...)``: scalar product; faster than a sum over an axis of two."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]
