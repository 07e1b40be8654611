"""Numbers printed in section 5 of Göttlich & Totzeck, to be set beside ours."""

from __future__ import annotations

#: The recordings of ESIMAS in the paper's numbering, 1 to 10.
RECORDINGS = (
    "1-1_1",
    "1-1_2",
    "2-1_1",
    "2-1_2",
    "3-1_1",
    "3-1_2",
    "4-1_1",
    "4-1_2",
    "5-1_1",
    "5-1_2",
)

#: Table (length): identified car lengths L, m.
LENGTHS = {
    "lin": (3.47, 3.95, 5.64, 4.50, 2.25, 2.54, 8.33, 7.07, 2.00, 7.16),
    "log": (8.24, 7.92, 9.20, 9.90, 7.17, 6.63, 9.98, 9.91, 5.52, 9.76),
}

#: Table (cost): values of the cost functional, m² s.
COSTS = {
    "n2": (54.68, 42.10, 98.67, 33.38, 24.10, 20.01, 39.73, 53.09, 10.37, 74.27),
    "n4": (54.25, 40.98, 108.80, 33.12, 20.68, 18.26, 40.43, 53.05, 8.11, 72.02),
    "n10": (50.43, 46.02, 94.69, 41.21, 24.81, 19.97, 43.35, 57.21, 9.23, 69.61),
    "lin": (49.11, 41.33, 96.91, 39.17, 23.11, 34.11, 39.39, 62.30, 15.21, 63.78),
    "log": (58.88, 50.04, 113.69, 71.31, 32.40, 59.59, 39.68, 57.72, 19.84, 89.24),
}

#: The averages as printed beside the tables: L in m, costs in m² s.
AVERAGE_LENGTHS = {"lin": 4.69, "log": 8.43}
AVERAGE_COSTS = {"n2": 45.04, "n4": 44.97, "n10": 45.65, "lin": 46.44, "log": 59.24}
