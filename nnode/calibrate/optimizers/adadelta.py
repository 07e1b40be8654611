"""ADADELTA with decaying Gaussian noise on the gradient, the paper's stochastic descent."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer


class NoisyAdadelta(Optimizer):
    """ADADELTA with noise of variance eta1 / (1 + k)^eta2 added to the k-th gradient.

    With g the noisy gradient, E[.] decaying averages with rate rho:

        E[g²] <- rho E[g²] + (1 - rho) g²
        delta = -lr sqrt(E[delta²] + eps) / (sqrt(E[g²]) + eps) g
        E[delta²] <- rho E[delta²] + (1 - rho) delta²

    The paper prints E[g²] with the gradient of the step before. ADADELTA as published by Zeiler
    (2012) includes the present gradient, without which the first step would divide by eps only.
    This class follows Zeiler.

    Args:
        params: parameters, as for every torch optimiser.
        lr: factor on the update, 1 in the paper.
        rho: decay rate of both averages.
        eps: keeps the quotient regular.
        eta1, eta2: variance of the noise; eta1 = 0 switches it off.
        seed: seed of the noise. Its generator is part of the state, so that a resumed run
            continues the same stream.

    Source:
        Göttlich & Totzeck, section 4.2 (rho 0.95, eps 1e-6, eta1 1, eta2 0.55).
    """

    def __init__(
        self,
        params: Iterable[Tensor] | Iterable[dict[str, Any]],
        lr: float = 1.0,
        rho: float = 0.95,
        eps: float = 1e-6,
        eta1: float = 1.0,
        eta2: float = 0.55,
        seed: int = 0,
    ) -> None:
        for name, value, good in (
            ("lr", lr, lr > 0),
            ("rho", rho, 0 < rho < 1),
            ("eps", eps, eps > 0),
            ("eta1", eta1, eta1 >= 0),
            ("eta2", eta2, eta2 >= 0),
        ):
            if not good:
                raise ValueError(f"{name}={value} is outside its range")
        defaults = {"lr": lr, "rho": rho, "eps": eps, "eta1": eta1, "eta2": eta2}
        super().__init__(params, defaults)
        self._generator = torch.Generator().manual_seed(seed)

    @property
    def noise(self) -> float:
        """Standard deviation of the noise in the last step."""
        group = self.param_groups[0]
        k = max((int(s["step"]) for s in self.state.values() if "step" in s), default=1) - 1
        return math.sqrt(group["eta1"] / (1 + k) ** group["eta2"])

    @torch.no_grad()
    def step(self, closure: Callable[[], Tensor] | None = None) -> Tensor | None:  # type: ignore[override]
        """Update the parameters; ``closure`` computes the cost and its gradient."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            for p in group["params"]:
                if p.grad is not None:
                    self._update(p, group)
        return loss

    def _update(self, p: Tensor, group: dict[str, Any]) -> None:
        state = self.state[p]
        if not state:
            state["step"] = 0
            state["square"] = torch.zeros_like(p)
            state["delta"] = torch.zeros_like(p)
        gradient = p.grad
        assert gradient is not None
        if group["eta1"] > 0:
            # drawn in float64 on the CPU, for the same stream in every precision and device
            noise = torch.randn(p.shape, generator=self._generator, dtype=torch.float64)
            spread = math.sqrt(group["eta1"] / (1 + state["step"]) ** group["eta2"])
            gradient = gradient + spread * noise.to(p)
        square, delta, rho, eps = state["square"], state["delta"], group["rho"], group["eps"]
        square.mul_(rho).addcmul_(gradient, gradient, value=1 - rho)
        step = gradient * (delta + eps).sqrt() / (square.sqrt() + eps) * -group["lr"]
        delta.mul_(rho).addcmul_(step, step, value=1 - rho)
        p.add_(step)
        state["step"] += 1

    def state_dict(self) -> dict[str, Any]:
        """The state, with that of the noise generator."""
        return {**super().state_dict(), "generator": self._generator.get_state()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the state and the noise generator."""
        state_dict = dict(state_dict)
        self._generator.set_state(state_dict.pop("generator"))
        super().load_state_dict(state_dict)
