"""Small scenes that the solvers' tests share."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from nnode.data.sequence import Sequence

MakePlatoon = Callable[..., Sequence]
MakeCrowd = Callable[..., Sequence]


@pytest.fixture(scope="session")
def platoon() -> MakePlatoon:
    """Make a platoon: gaps (m) from the last vehicle on, speed (m/s), samples; slightly noisy."""

    def make(
        gaps: list[float],
        speed: float = 15.0,
        samples: int = 6,
        dt: float = 0.2,
        name: str = "p",
        start: float = 12.0,
        noise: float = 0.3,
    ) -> Sequence:
        t = dt * np.arange(samples)
        x = start + np.concatenate([[0.0], np.cumsum(gaps)])[None] + speed * t[:, None]
        draw = np.random.default_rng(len(gaps) + 10 * samples)
        # nothing may lean on the start: only later samples are disturbed
        x[1:] += noise * draw.standard_normal(x[1:].shape)
        return Sequence(name=name, recording="r", time=3.0 + t, x=x[:, :, None])

    return make


@pytest.fixture(scope="session")
def ragged(platoon) -> list[Sequence]:  # type: ignore[no-untyped-def]
    """Platoons of one to four vehicles that end at different times."""
    return [
        platoon([12.0, 25.0, 9.0], samples=4, name="a"),
        platoon([7.0], samples=7, name="b"),
        platoon([], samples=2, name="c"),
        platoon([14.0, 11.0], samples=6, name="d", start=700.0),
    ]


@pytest.fixture(scope="session")
def equal(platoon) -> list[Sequence]:  # type: ignore[no-untyped-def]
    """Forty platoons of four vehicles: more than one block, and blocks that are not full."""
    return [
        platoon([10.0 + 0.3 * i, 20.0 - 0.2 * i, 15.0], samples=4, name=f"e{i}") for i in range(40)
    ]


@pytest.fixture(scope="session")
def crowd() -> MakeCrowd:
    """Make people in a corridor, 0 <= y <= 3; neighbours are ``apart`` (m) from each other."""

    def make(
        n: int, samples: int = 5, dt: float = 0.2, apart: float = 0.42, name: str = "c"
    ) -> Sequence:
        draw = np.random.default_rng(n)
        x0 = np.stack([apart * np.arange(n), 0.2 + 0.01 * np.arange(n) ** 2], 1)
        v = np.array([1.3, 0.1]) + 0.1 * draw.standard_normal((n, 2))
        t = dt * np.arange(samples)[:, None, None]
        x = x0 + t * v
        return Sequence(
            name=name,
            recording="r",
            time=t[:, 0, 0],
            x=x,
            v=np.broadcast_to(v, x.shape),
            destination=x0 + np.array([6.0, 0.5]),
            walls=np.array([[-1.0, 0.0, 4.0, 0.0], [4.0, 3.0, -1.0, 3.0]])[: n - 1],
        )

    return make
