"""Published figures.

Sources: Wen, Jian & He 2023, IEEE Transactions on Intelligent Transportation Systems,
doi 10.1109/TITS.2023.3298150, with github.com/18627242758/IQ-Learn-car-following (errors of the
intelligent driver model recomputed from its parameters by the source's own stepping); Schöller,
Aravantinos, Lay & Knoll 2020, What the Constant Velocity Model Can Teach Us About Pedestrian Motion
Prediction, with github.com/cschoeller/constant_velocity_pedestrian_motion.
"""

from __future__ import annotations

#: Root mean square percentage error of spacings: calibration by a genetic algorithm, training and
#: test events.
IDM = (0.2303, 0.2782)
#: The same on the test events of the best logged epoch of their learned model, chosen on them.
LEARNED = 0.201
#: Mean and last distance (m) of constant velocity on all windows of 20 samples, by scene.
CONSTANT_VELOCITY = {
    "eth_univ": (1.08, 2.28),
    "eth_hotel": (0.32, 0.61),
    "ucy_univ": (0.52, 1.17),
    "ucy_zara01": (0.43, 0.95),
    "ucy_zara02": (0.32, 0.72),
}
