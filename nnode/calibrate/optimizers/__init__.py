"""Optimisers of the training loop, by name."""

from nnode.calibrate.optimizers.by_name import (
    OPTIMIZERS,
    AdadeltaOptions,
    AdamOptions,
    ConsensusOptions,
    GaussNewtonOptions,
    LbfgsOptions,
    OptimizerOptions,
    build_optimizer,
    needs_full_batch,
)

__all__ = [
    "OPTIMIZERS",
    "AdadeltaOptions",
    "AdamOptions",
    "ConsensusOptions",
    "GaussNewtonOptions",
    "LbfgsOptions",
    "OptimizerOptions",
    "build_optimizer",
    "needs_full_batch",
]
