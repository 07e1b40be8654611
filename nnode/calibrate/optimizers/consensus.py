"""Consensus-based optimisation: a global, gradient-free method, through the CBX package."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import torch
from cbx.dynamics import CBO
from torch import Tensor
from torch.optim import Optimizer


class ConsensusBased(Optimizer):
    """Consensus-based optimisation behind torch's optimiser interface.

    Particles start normally distributed around the start parameters, drift towards their
    Gibbs-weighted mean and diffuse in proportion to their distance from it. After each step the
    parameters hold the best particle that was met. Costs of different steps are compared, so
    all sequences belong into one mini-batch.

    Args:
        params: parameters.
        particles: their number; each costs one simulation per step.
        spread: standard deviation of the start around each parameter p, times max(1, |p|).
        alpha: inverse temperature of the weights, relative to the spread of the costs.
        drift: drift rate lambda.
        sigma: strength of the (anisotropic) diffusion.
        dt: step of the dynamics.
        project: moves the parameters into the admissible set.
        seed: of start and diffusion.
        evaluate: all particles ``(P, K)`` at once to their ``(P,)`` costs; without it, a closure
            computes them one after the other.

    Source:
        Pinnau, Totzeck, Tse & Martin (2017); CBX, https://pdips.github.io/CBXpy.
    """

    def __init__(
        self,
        params: Iterable[Tensor],
        particles: int = 30,
        spread: float = 0.5,
        alpha: float = 30.0,
        drift: float = 1.0,
        sigma: float = 2.0,
        dt: float = 0.1,
        project: Callable[[], None] | None = None,
        seed: int = 0,
        evaluate: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        for name, value, good in (
            ("particles", particles, particles >= 2),
            ("spread", spread, spread > 0),
            ("alpha", alpha, alpha > 0),
            ("drift", drift, drift > 0),
            ("sigma", sigma, sigma >= 0),
            ("dt", dt, dt > 0),
        ):
            if not good:
                raise ValueError(f"{name}={value} is outside its range")
        super().__init__(params, {"lr": dt})
        self._alpha, self._drift, self._sigma, self._dt = alpha, drift, sigma, dt
        self._project, self._evaluate = project, evaluate
        self._generator = torch.Generator().manual_seed(seed)
        start = self._get()
        noise = self._normal((particles, start.size))
        noise[0] = 0.0  # the start itself is a particle
        self._x = start + spread * np.maximum(1.0, np.abs(start)) * noise
        self._best, self._best_cost = start.copy(), float("inf")

    def _normal(self, size: tuple[int, ...]) -> np.ndarray:
        return torch.randn(size, generator=self._generator, dtype=torch.float64).numpy()

    def _tensors(self) -> list[Tensor]:
        return [p for group in self.param_groups for p in group["params"]]

    def _get(self) -> np.ndarray:
        flat = torch.cat([p.detach().reshape(-1) for p in self._tensors()])
        return flat.cpu().double().numpy()

    @torch.no_grad()
    def _set(self, x: np.ndarray) -> None:
        flat, start = torch.from_numpy(np.ascontiguousarray(x)), 0
        for p in self._tensors():
            p.copy_(flat[start : start + p.numel()].view_as(p))
            start += p.numel()

    @torch.no_grad()
    def step(self, closure: Callable[[], Tensor] | None = None) -> Tensor | None:  # type: ignore[override]
        """Evaluate all particles and move them once; returns the best cost so far."""
        for i, particle in enumerate(self._x):
            self._set(particle)
            if self._project is not None:
                self._project()
            self._x[i] = self._get()
        costs = self._costs(closure)
        costs = np.where(np.isfinite(costs), costs, np.inf)
        least = int(costs.argmin())
        if costs[least] < self._best_cost:
            self._best, self._best_cost = self._x[least].copy(), float(costs[least])
        finite = costs[np.isfinite(costs)]
        scale = float(np.median(finite) - finite.min()) if finite.size else 1.0
        # the weights depend on differences of the costs alone; taken from the least one, they
        # keep their digits, and a particle without a cost has no weight
        energy = costs - finite.min() if finite.size else np.zeros_like(costs)
        dynamic = CBO(
            lambda x: energy[None],
            f_dim="3D",
            check_f_dims=False,
            x=self._x[None].copy(),
            alpha=self._alpha / max(scale, 1e-12),
            lamda=self._drift,
            sigma=self._sigma,
            dt=self._dt,
            noise="anisotropic",
            sampler=self._normal,
            verbosity=0,
        )
        dynamic.step()
        self._x = np.asarray(dynamic.x[0])
        self._set(self._best)
        return torch.tensor(self._best_cost, dtype=torch.float64)

    def _costs(self, closure: Callable[[], Tensor] | None) -> np.ndarray:
        if self._evaluate is not None:
            return self._evaluate(torch.from_numpy(self._x.copy())).double().numpy()
        if closure is None:
            raise ValueError("consensus-based optimisation needs a closure that returns the cost")
        found = []
        for particle in self._x:
            self._set(particle)
            found.append(float(closure()))
        return np.array(found)

    def state_dict(self) -> dict[str, Any]:
        """Particles, best one and generator; everything that resuming needs."""
        return {
            "x": torch.from_numpy(self._x.copy()),
            "best": torch.from_numpy(self._best.copy()),
            "best_cost": self._best_cost,
            "generator": self._generator.get_state(),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave."""
        self._x = state_dict["x"].numpy().copy()
        self._best = state_dict["best"].numpy().copy()
        self._best_cost = float(state_dict["best_cost"])
        self._generator.set_state(state_dict["generator"])
