"""Windows of time, in which every person is simulated among the measured paths of the others."""

from __future__ import annotations

from collections.abc import Sequence as Many
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from nnode.data.sequence import PADDING_GAP, Batch, Sequence, collate
from nnode.diagnosis.crowds.paths import Smoother
from nnode.errors import DataError
from nnode.model.scene import Scene
from nnode.model.system import System
from nnode.simulation.alone import Surroundings

#: Longest step of a simulation, and the approximate interval of the residuals, s.
STEP = 0.13
INTERVAL = 0.1
#: Smallest number of samples of a window; a start state has four numbers.
LEAST = 5
#: Windows are shortened until at most this share of the usable sequences is shorter, and then, to a
#: half at most, until they leave out at most this share of the samples that shorter ones use.
LEFT_OUT = 0.1
#: A wall point further away than r + CUT * B is left out: exp(-CUT) of the force at contact.
CUT = 11.0
#: How far a simulated person may stray from the measured path before walls are missed, m.
STRAY = 0.5


class Individuals(NamedTuple):
    """In what people differ.

    Attributes:
        speed: ``(P,)`` desired speeds, m/s.
        turn: ``(P,)`` by which the desired directions are turned to the left from those to the
            destinations, rad.
        factors: name of a parameter of the law to ``(P,)`` factors on its value.
    """

    speed: np.ndarray
    turn: np.ndarray
    factors: dict[str, np.ndarray]

    def of(self, person: np.ndarray) -> Individuals:
        """Those with the numbers ``(M,)``."""
        factors = {name: factor[person] for name, factor in self.factors.items()}
        return Individuals(self.speed[person], self.turn[person], factors)


class Windows:
    """The windows of some sequences.

    Args:
        sequences: of people, equally sampled.
        window: largest length, s, see :data:`LEFT_OUT`.

    Attributes:
        batch: one simulation per window. Positions and velocities are the smoothed ones, at half
            steps of the simulation; after the last sample of a sequence they do not change.
        measured: ``(L, W, N, 2)`` m: positions as they were measured, at the L residual times.
        person: ``(P, 2)`` window and place of the P people of all windows who are real.
        sequence, number: ``(W,)`` position of a window's sequence, and its own within it.
        step: of the simulation, s. sub: steps between two residuals.
        used: positions of the sequences that are long enough.
        compared: of these the first sample that is compared, and the stride from each to the next.
        preferred: of these ``(N, 2)`` velocities, m/s: as measured before the sequence, or else the
            mean within it.
        variance: m², of the noise of one measured coordinate.

    Raises:
        DataError: no sequence is long enough, or another fault of the data.
    """

    def __init__(self, sequences: Many[Sequence], window: float) -> None:
        dt = sequences[0].dt
        stride = max(1, round(INTERVAL / dt))
        count = [(item.n_samples + stride - 1) // stride for item in sequences]
        sufficient = sorted(number for number in count if number >= LEAST)
        if not sufficient:
            raise DataError(
                f"the longest sequence has {max(item.n_samples for item in sequences)} samples "
                f"of {dt:g} s, a window needs {LEAST * stride}; use longer sequences"
            )
        # a few long sequences must not exclude the short ones
        longest = sufficient[int(LEFT_OUT * len(sufficient))]
        most = min(max(LEAST + 1, round(window / (stride * dt))), longest)
        samples = {
            length: sum(number // length * length for number in count)
            for length in range(most, max(LEAST, most // 2) - 1, -1)
        }
        used = (1 - LEFT_OUT) * max(samples.values())
        length = next(length for length, number in samples.items() if number >= used)
        self.used = [i for i, number in enumerate(count) if number >= length]
        smoother = Smoother([sequences[i] for i in self.used])
        self.variance = smoother.variance
        self.sub = max(1, int(np.ceil(stride * dt / STEP)))
        self.step = stride * dt / self.sub
        self.length = length
        half = np.arange(2 * self.steps + 1) * self.step / 2
        pieces, measured, sequence, number = [], [], [], []
        self.compared: dict[int, tuple[int, int]] = {}
        self.preferred: dict[int, np.ndarray] = {}
        for i in self.used:
            item, windows = sequences[i], count[i] // length
            spare = (count[i] - windows * length) // 2
            self.compared[i] = (spare * stride, stride)
            preferred = self.preferred[i] = _preferred(item, smoother)
            for w in range(windows):
                first = (spare + w * length) * stride
                path = smoother.path(item, np.minimum(first * dt + half, dt * (item.n_samples - 1)))
                time = item.time[0] + first * dt + half
                pieces.append(_piece(item, time, path.x, path.v, preferred))
                measured.append(item.x[first::stride][:length])
                sequence.append(i)
                number.append(w)
        self.batch = collate(pieces)
        _park(self.batch)
        self.measured = np.zeros((length, *self.batch.x.shape[1:]))
        for w, x in enumerate(measured):
            self.measured[:, w, : x.shape[1]] = x
        self.person = np.argwhere(self.batch.agent.numpy())
        self.sequence, self.number = np.array(sequence), np.array(number)

    @property
    def interval(self) -> float:
        """s, between two residuals."""
        return self.sub * self.step

    @property
    def steps(self) -> int:
        """Steps of the simulation of a window, to the start of the next one."""
        return self.sub * self.length

    def around(self, system: System, people: Individuals | None = None) -> Surroundings:
        """The surroundings of the people whom ``system`` simulates.

        Args:
            people: P people; None: with the measured preferred speeds, towards the destinations.
        """
        scene = system.scene(self.batch)
        window, person = torch.from_numpy(self.person).T
        if people is not None:
            speed, turn = map(torch.from_numpy, people[:2])
            scene.preferred = torch.zeros_like(scene.preferred)
            scene.preferred[window, person, 0] = speed
            turn_destinations(scene, self.batch.x[0], window, person, turn)
        # terms read the paths from ``Surroundings``, so copies for many runs need only two samples
        scene.measured, scene.measured_rate = scene.measured[:2], scene.measured_rate[:2]
        force: Any = system.find_law("social_force")
        if force is not None and scene.wall.shape[1]:
            reach = force.r + CUT * force.B + STRAY
            scene.near = _near(scene, self.batch.x[:: 2 * self.sub], reach)
        factors = {} if people is None else people.factors
        return Surroundings(scene, self.batch.x, self.batch.v, window, person, self.step, factors)


def turn_destinations(
    scene: Scene, start: Tensor, window: Tensor, person: Tensor, turn: Tensor
) -> None:
    """Turn the ways of P people to their destinations to the left.

    Args:
        start: ``(B, N, 2)`` where they start, m. window, person: ``(P,)`` of the people.
        turn: ``(P,)`` rad.
    """
    first = start[window, person]
    x, y = (scene.destination[window, person] - first).unbind(-1)
    cosine, sine = turn.cos(), turn.sin()
    scene.destination = scene.destination.clone()
    turned = torch.stack([cosine * x - sine * y, sine * x + cosine * y], -1)
    scene.destination[window, person] = first + turned


def _preferred(item: Sequence, smoother: Smoother) -> np.ndarray:
    """See :attr:`Windows.preferred`."""
    ends = smoother.path(item, np.array([0.0, item.dt * (item.n_samples - 1)])).x
    mean: np.ndarray = (ends[1] - ends[0]) / (item.dt * (item.n_samples - 1))
    if item.preferred is None:
        return mean
    return np.where(np.isfinite(item.preferred), item.preferred, mean)


def _piece(
    item: Sequence, time: np.ndarray, x: np.ndarray, v: np.ndarray, preferred: np.ndarray
) -> Sequence:
    destination = item.x[-1] if item.destination is None else item.destination
    return Sequence(
        name=item.name,
        recording=item.recording,
        time=time,
        x=x,
        v=v,
        kind=item.kind,
        group=item.group,
        destination=destination,
        preferred=preferred,
        walls=item.walls,
    )


def _park(batch: Batch) -> None:
    """Move padding agents far away from all others and from their destinations, so that directions
    are finite."""
    far = PADDING_GAP * torch.arange(1, batch.x.shape[2] + 1, dtype=batch.x.dtype)
    place = far[:, None].expand(-1, 2)
    batch.x = torch.where(batch.agent[..., None], batch.x, place)
    batch.destination = torch.where(batch.agent[..., None], batch.destination, place + 10.0)


def _near(scene: Scene, x: Tensor, reach: float) -> tuple[Tensor, Tensor, Tensor]:
    """The wall points within ``reach`` (m) of each person's path ``(L, B, N, 2)``."""
    middle = (x.amax(0) + x.amin(0)) / 2
    radius = torch.linalg.vector_norm(x - middle, dim=-1).amax(0)
    d = torch.linalg.vector_norm(middle[:, :, None] - scene.wall[:, None], dim=-1)
    real = (d < reach + radius[..., None]) & scene.wall_point[:, None]
    n_points = max(int(real.sum(-1).max()), 1)
    # real points first; the mask excludes the others
    index = torch.argsort((~real).to(torch.int8), dim=-1, stable=True)[..., :n_points]
    places = index[..., None].expand(*index.shape, 2)
    shape = (*real.shape, 2)
    wall = scene.wall[:, None].expand(shape).gather(2, places)
    normal = scene.wall_normal[:, None].expand(shape).gather(2, places)
    return wall, normal, real.gather(2, index)
