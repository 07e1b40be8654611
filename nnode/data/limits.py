"""Limits that data are judged by: what is physically possible, and what is usual.

Every check takes its thresholds from here: the faults of sequences and the findings of a file
(:mod:`nnode.data.quality`), identifiers (:mod:`nnode.data.identity`), the recognition of units
(:mod:`nnode.data.units`) and the readers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from nnode.data.sequence import Domain

#: Share of the sampling interval by which a time may deviate from equal steps.
UNEVEN = 0.01
#: A step longer than this many sampling intervals is a hole.
HOLE = 1.5
#: Standard deviations of a step's error that are no fault: noise exceeds them once in 16,000 steps.
NOISY = 4.0
#: m/s²; the greatest acceleration over a second, of a tyre on a dry road (coefficient of friction
#: about 1) and of a shoe: that of gravity.
FRICTION = 9.81
#: Share of the covered length at either end in which agents may enter and leave.
EDGE = 0.1
#: A finding concerns single agents up to this share, and the whole file above it.
FEW = 0.02
#: A kind of fault in more than this share of the sequences is an error of the file.
MANY = 0.1
#: m/s; first speeds that are wrong by more are not taken from single samples. A follower forgets
#: its first speed within about 2.5 s (idm with T = 1.4 s, a = 1.2 m/s²), so that 0.2 m/s move its
#: path by 0.5 m, the error that a single position may have (nnode.data.quality). In simulations
#: of idm, 40 followers for 40 s, errors of 0.07 m/s leave all parameters within 1 %, those of
#: 0.28 m/s lead to errors of 1 % of v0 and 5 % of s0, those of 0.7 m/s of 2 % and 13 % (table in
#: docs/data.md).
BEARABLE = 0.2


@dataclass(frozen=True)
class Limits:
    """What is physically possible.

    Attributes:
        max_speed: m/s. 60 (216 km/h) for vehicles; 5 for people in a corridor, who walk at
            1-2 and would have to run.
        max_reverse: m/s at which a vehicle may go backwards: 10, what a reverse gear allows.
            Beyond it a step back is a jump.
        noise: m, an error that a single position may have without being a fault: 0.5 for a
            vehicle in a road camera's image, 0.1 for a head seen from above.
        spacing: m. Fronts of consecutive vehicles in one lane: 2, as no car is shorter.
            Centres of two people: 0.1, half the breadth of a head.
        reach: m within which a position continues a path extrapolated at constant velocity:
            5, a car's length, or 0.4, a person's depth. Decides between swap and jump.
        min_agents, min_samples: needed for an interaction and for an acceleration.
    """

    max_speed: float
    max_reverse: float
    noise: float
    spacing: float
    reach: float
    min_agents: int
    min_samples: int = 3


#: Limits by domain.
LIMITS: dict[Domain, Limits] = {
    "traffic": Limits(
        max_speed=60.0, max_reverse=10.0, noise=0.5, spacing=2.0, reach=5.0, min_agents=2
    ),
    "crowd": Limits(
        max_speed=5.0,
        max_reverse=5.0,
        noise=0.1,
        spacing=0.1,
        reach=0.4,
        min_agents=1,
    ),
}


@dataclass(frozen=True)
class Range:
    """Where a median lies, and by what factor (its logarithm's standard deviation) it may miss it.

    Attributes:
        low, high: SI units.
        spread: of the logarithm.
        source: in words.
    """

    low: float
    high: float
    spread: float
    source: str

    def score(self, value: float) -> float:
        """Logarithm of the likelihood, 0 within; at least -12: one median shall not decide all."""
        if not (value > 0 and math.isfinite(value)):
            return 0.0
        away = max(math.log(self.low / value), math.log(value / self.high), 0.0) / self.spread
        return max(-0.5 * away**2, -12.0)


#: What is usual, by domain and quantity.
USUAL: dict[Domain, dict[str, Range]] = {
    "crowd": {
        "speed": Range(
            0.2,
            1.6,
            0.19,
            "free walking 1.34 ± 0.26 m/s (Weidmann 1993), less in a crowd",
        ),
        "nearest": Range(
            0.4,
            6.0,
            0.3,
            "5.4 people on a square metre at most (Weidmann 1993), 0.43 m from each other",
        ),
        "sway": Range(
            0.8,
            1.08,
            0.08,
            "people sway once in two steps, of which they make 2.0 ± 0.13 in a second (MacDougall "
            "& Moore 2005), 1.6 in a dense crowd",
        ),
    },
    "traffic": {
        "speed": Range(1.0, 42.0, 0.2, "from a jam to 150 km/h"),
        "nearest": Range(
            5.5,
            120.0,
            0.25,
            "a car's length and the gap of standing cars (Treiber & Kesting 2013: 2 m); at most "
            "about 5 s behind at 25 m/s",
        ),
        "length": Range(3.5, 7.0, 0.12, "cars are 3.5 to 5 m long; up to half trucks"),
    },
}
#: s; sampled more coarsely, people's sway does not show.
SWAYS = 1 / 3
INTERVAL = Range(0.02, 1.0, 0.4, "recordings take 1 to 50 samples in a second")
#: How near speeds in a file are to those of its positions; beyond, one of them is wrong.
AGREE = Range(0.995, 1.005, 0.025, "two measurements of one motion")
