"""Vectors in the plane."""

from __future__ import annotations

import torch
from torch import Tensor

from nnode.model.terms import SMOOTHING


def norm(vector: Tensor) -> Tensor:
    """``(..., 2)`` to ``(...)``: Euclidean length with a finite gradient everywhere."""
    return torch.sqrt(dot(vector, vector) + SMOOTHING**2)


def dot(a: Tensor, b: Tensor) -> Tensor:
    """``(..., 2)`` twice to ``(...)``: scalar product; faster than a sum over an axis of two."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]
