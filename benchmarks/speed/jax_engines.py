"""Traffic models in JAX, as strong competitors: ``lax.scan`` and diffrax, one thread."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.speed.problems import Problem

# read once, when JAX starts
os.environ.setdefault(
    "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
)

import jax
import jax.numpy as jnp


def _law(model: str) -> Callable[[dict[str, Any], Any], Any]:
    if model == "lin":
        return lambda p, gap: p["v0"] - p["v0"] * p["L"] / gap
    if model == "log":
        return lambda p, gap: p["v0"] * jnp.log(jnp.maximum(gap, 1e-3) / p["L"])

    def network(p: dict[str, Any], gap: Any) -> Any:
        first, second = "network.layers.0.", "network.layers.1."
        total = p[second + "bias"][0]
        for j in range(p[first + "bias"].shape[0]):
            z = p[first + "weight"][j, 0] * gap + p[first + "bias"][j]
            total = total + p[second + "weight"][0, j] * jax.nn.softplus(z)
        return total

    return network


def jax_call(problem: Problem, arrangement: str) -> Callable[[], tuple[np.ndarray, np.ndarray]]:
    """The compiled cost and gradient of a traffic problem without padding.

    Args:
        arrangement: ``scan`` or ``diffrax``; with ``_batch_last`` the simulations are the
            innermost axis, so that they fill vector registers.
    """
    last = arrangement.endswith("_batch_last")
    shape, law = problem.shape, _law(problem.model)
    turn = (0, 2, 1) if last else (0, 1, 2)
    measured = jnp.asarray(problem.batch.relative_to(None).x[..., 0].numpy().transpose(turn))
    names = [name.removeprefix("terms.0.") for name, _ in problem.system.named_parameters()]
    values = {
        name: jnp.asarray(p.detach().numpy())
        for name, p in zip(names, problem.system.parameters(), strict=True)
    }
    axis = 0 if last else 1
    kind = measured.dtype

    def rate(p: dict[str, Any], x: Any) -> Any:
        gap = jnp.diff(x, axis=axis)
        lead = jnp.broadcast_to(p["v0"], x[:1].shape if last else x[:, :1].shape)
        return jnp.concatenate([law(p, gap), lead], axis).astype(kind)

    def by_scan(p: dict[str, Any]) -> Any:
        def step(x: Any, _: None) -> tuple[Any, None]:
            return x + jnp.asarray(shape.step, kind) * rate(p, x), None

        def sample(x: Any, _: None) -> tuple[Any, Any]:
            x, _ = jax.lax.scan(step, x, None, length=shape.per)
            return x, x

        _, found = jax.lax.scan(sample, measured[0], None, length=shape.samples)
        return jnp.concatenate([measured[:1], found])

    def by_diffrax(p: dict[str, Any]) -> Any:
        import diffrax

        # time counts steps, which is exact
        term = diffrax.ODETerm(lambda t, x, p: jnp.asarray(shape.step, kind) * rate(p, x))
        times = shape.per * jnp.arange(shape.samples + 1, dtype=kind)
        solution = diffrax.diffeqsolve(
            term,
            diffrax.Euler(),
            t0=times[0],
            t1=times[-1],
            dt0=1.0,
            y0=measured[0],
            args=p,
            saveat=diffrax.SaveAt(ts=times),
            # as many checkpoints as steps: nothing is computed twice
            adjoint=diffrax.RecursiveCheckpointAdjoint(checkpoints=shape.steps),
            max_steps=shape.steps + 1,
        )
        return solution.ys

    simulate = by_diffrax if arrangement.startswith("diffrax") else by_scan

    def cost(p: dict[str, Any]) -> tuple[Any, Any]:
        x = simulate(p)
        return 0.5 * problem.batch.dt * jnp.sum((x - measured) ** 2), x

    compiled = jax.jit(jax.value_and_grad(cost, has_aux=True))

    def call() -> tuple[np.ndarray, np.ndarray]:
        (_, x), grads = compiled(values)
        found = np.asarray(x).transpose(turn)[..., None]
        return found, np.concatenate([np.asarray(grads[name]).ravel() for name in names])

    return call
