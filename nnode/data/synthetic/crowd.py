"""Two-way flow of people in a corridor, written like the trajectories of the Jülich archive."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

#: Distance (m) beyond the measured stretch at which people enter and leave.
_APPROACH = 1.0
#: Distance (m) beyond the way out that people walk towards.
_AHEAD = 5.0
#: The archive's dummy for the height of a head, cm.
_HEIGHT = 176


@dataclass(frozen=True, kw_only=True)
class Forces:
    """Parameters of the social force model; symbols of the paper."""

    A: float = 20.0  # N
    k: float = 40.0  # kg/s²
    kappa: float = 10.0  # kg/(m s)
    B: float = 0.05  # m
    r: float = 0.25  # m
    tau: float = 0.5  # s
    mass: float = 1.0  # kg


def social_force(offset: np.ndarray, slip: np.ndarray, reach: float, forces: Forces) -> np.ndarray:
    """Force of a person or of a wall point, N.

    Args:
        offset: ``(..., 2)`` m, from the other to the person; never zero.
        slip: ``(..., 2)`` m/s, the velocity whose tangential part the friction acts along:
            that of the other relative to the person, or the person's own at a wall.
        reach: sum of the radii, m.
        forces: A, k, kappa and B.

    Source: Göttlich & Totzeck, equation (InteractionForceHelbing).
    """
    distance = np.hypot(offset[..., 0], offset[..., 1])
    normal = offset / distance[..., None]
    tangent = np.stack([-normal[..., 1], normal[..., 0]], axis=-1)
    overlap = reach - distance
    contact = np.maximum(overlap, 0.0)
    push = forces.A * np.exp(overlap / forces.B) + forces.k * contact
    drag = forces.kappa * contact * np.einsum("...d,...d", slip, tangent)
    return push[..., None] * normal + drag[..., None] * tangent


def crowd_recording(
    path: Path | str,
    *,
    seed: int,
    forces: Forces | None = None,
    people: int = 30,
    duration: float = 20.0,
    length: float = 10.0,
    width: float = 4.0,
    speed: tuple[float, float] = (1.2, 1.5),
    mixing: float = 0.0,
    frame_rate: float = 25.0,
    wall_spacing: float = 0.25,
    noise: float = 0.002,
) -> Path:
    """Simulate a corridor that people enter at both ends and write it as a text file.

    Everyone is accelerated by the relaxation towards a point straight ahead, by the mean over
    the people of the pair force, and by the mean over the wall points of the wall force. People
    enter until 60 % of the duration has passed, and are measured between -length/2 and length/2.

    Args:
        path: the file; folders are created.
        seed: the same seed gives the same bytes.
        forces: parameters; None takes the defaults of :class:`Forces`.
        people: number of people, both directions together.
        duration: s.
        length, width: m; the corridor's axis is x, its walls are at y = 0 and y = width.
        speed: slowest and fastest speed of entering, m/s.
        mixing: share of people who enter anywhere across the corridor; the others keep to
            its half on their right, as two-way flows come to do by themselves. The law gives
            nobody a desired speed to return to, so that a crowd that is mixed jams for good.
        frame_rate: 1/s.
        wall_spacing: distance of the stationary points that make up a wall, m.
        noise: standard deviation of the measured positions, m.

    Returns:
        The path: header lines with the frame rate, then id, frame, x, y, z (cm).

    Source: Göttlich & Totzeck, section 6.1.
    """
    forces = forces or Forces()
    rng = np.random.default_rng(seed)
    end = length / 2 + _APPROACH
    along = np.linspace(-end, end, 1 + round(2 * end / wall_spacing))
    wall = np.array([(x, y) for y in (0.0, width) for x in along])
    entry = np.sort(rng.uniform(0.0, 0.6 * duration, people))
    entry[0] = 0.0  # nobody waits for the first person
    heading = np.where(rng.permutation(people) % 2 == 0, 1.0, -1.0)
    pace = rng.uniform(*speed, people)
    margin = 2 * forces.r
    low, high = np.full(people, margin), np.full(people, width - margin)
    keeps_right = rng.random(people) >= mixing
    high[keeps_right & (heading > 0)] = width / 2
    low[keeps_right & (heading < 0)] = width / 2
    first_frame = np.ceil(entry * frame_rate).astype(int)

    state = np.empty((0, 4))  # x, y, vx, vy of those present
    present = np.empty(0, dtype=int)
    goal = np.empty((people, 2))
    rows: list[np.ndarray] = []
    for frame in range(int(duration * frame_rate) + 1):
        inside = heading[present] * state[:, 0] < end
        state, present = state[inside], present[inside]
        for i in np.flatnonzero(first_frame == frame):
            y = _free_lane(rng, state[:, :2], -heading[i] * end, low[i], high[i])
            goal[i] = heading[i] * (end + _AHEAD), y
            newcomer = [-heading[i] * end, y, heading[i] * pace[i], 0.0]
            state, present = np.vstack([state, newcomer]), np.append(present, i)
        inside_view = np.abs(state[:, 0]) <= length / 2
        at = np.full(inside_view.sum(), frame)
        rows.append(np.column_stack([present[inside_view] + 1, at, state[inside_view, :2]]))
        if len(present):
            state = _advance(state, goal[present], wall, 1 / frame_rate, forces)
    table = np.concatenate(rows)
    table[:, 2:] += noise * rng.standard_normal((len(table), 2))
    return _write(Path(path), table, frame_rate)


def _advance(
    state: np.ndarray, goal: np.ndarray, wall: np.ndarray, dt: float, forces: Forces
) -> np.ndarray:
    """``(N, 4)`` positions and velocities after ``dt`` (s)."""
    n = len(state)
    apart = ~np.eye(n, dtype=bool)

    def rates(_: float, flat: np.ndarray) -> np.ndarray:
        x, v = np.split(flat.reshape(n, 4), 2, axis=1)
        way = goal - x
        desired = way * (np.linalg.norm(v, axis=1) / np.linalg.norm(way, axis=1))[:, None]
        pull = (desired - v) / forces.tau
        pair = np.zeros((n, n, 2))
        offset, slip = x[:, None] - x, v - v[:, None]
        pair[apart] = social_force(offset[apart], slip[apart], 2 * forces.r, forces)
        walker = np.broadcast_to(v[:, None], (n, len(wall), 2))
        from_wall = social_force(x[:, None] - wall, walker, forces.r, forces)
        push = (pair.sum(1) / n + from_wall.mean(1)) / forces.mass
        return np.column_stack([v, pull + push]).ravel()

    path = solve_ivp(rates, (0.0, dt), state.ravel(), rtol=1e-7, atol=1e-9, first_step=dt / 2)
    return np.asarray(path.y[:, -1]).reshape(n, 4)


def _free_lane(
    rng: np.random.Generator, others: np.ndarray, x: float, low: float, high: float
) -> float:
    """The freest of some random places between ``low`` and ``high`` to enter at ``x``, m."""
    tries = rng.uniform(low, high, 8)
    if not len(others):
        return float(tries[0])
    space = np.hypot(others[:, 0] - x, others[:, 1] - tries[:, None]).min(axis=1)
    return float(tries[space.argmax()])


def _write(path: Path, table: np.ndarray, frame_rate: float) -> Path:
    """Write id, frame, x, y (m) person by person, in cm, with the archive's header lines."""
    table = table[np.lexsort((table[:, 1], table[:, 0]))]
    lines = [
        "# synthetic two-way flow in a corridor",
        f"# framerate: {frame_rate:g} fps",
        "# id frame x/cm y/cm z/cm",
    ]
    lines += [
        f"{int(who)} {int(frame)} {100 * x:.3f} {100 * y:.3f} {_HEIGHT}"
        for who, frame, x, y in table
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(("\n".join(lines) + "\n").encode("ascii"))
    return path
