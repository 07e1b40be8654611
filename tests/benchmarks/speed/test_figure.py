"""Time of a gradient against the size of the problem."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.speed.engines import ENGINES
from benchmarks.speed.figure import LOOKS, performance_figure


def _row(shape: str, agents: int, steps: int, **medians: float) -> dict[str, Any]:
    return {
        "shape": shape,
        "model": "n4" if shape == "steps" else "sf",
        "sequences": 34 if shape == "steps" else 1,
        "agents": agents,
        "steps": steps,
        "engines": {
            name: {"median": t, "min": 0.9 * t, "max": 1.5 * t} for name, t in medians.items()
        },
    }


STEPS = [
    _row("steps", 4, 1000, odeint=0.2, fused_1=1e-3, fused_2=8e-4),
    _row("steps", 4, 100, odeint=0.02, fused_1=2e-4, fused_2=2e-4),
]
PEOPLE = [
    _row("people", 50, 25, odeint=0.03, fused_1=1e-3),
    _row("scale", 500, 25, odeint=1.0, fused_1=6e-3),
    _row("scale", 1000, 25, fused_1=1.2e-2),
]


def _figure(*problems: dict[str, Any]):  # type: ignore[no-untyped-def]
    machine = {"processor": "abacus"}
    return performance_figure({"machine": machine, "dtype": "float32", "problems": [*problems]})


def _line(ax, gid: str):  # type: ignore[no-untyped-def]
    (line,) = [line for line in ax.get_lines() if line.get_gid() == gid]
    return line


def test_medians_in_order_over_steps_and_over_people() -> None:
    figure = _figure(*STEPS, _row("paper", 4, 600, odeint=0.1), *PEOPLE)
    steps, people = figure.axes
    for ax, x in ((steps, "Euler steps"), (people, "people")):
        assert (ax.get_xscale(), ax.get_yscale(), ax.get_xlabel()) == ("log", "log", x)
        assert ax.get_ylabel() == "time of one gradient (s)"
    for ax, engine, x, y in (
        (steps, "odeint", [100, 1000], [0.02, 0.2]),
        (steps, "fused_2", [100, 1000], [2e-4, 8e-4]),
        # an engine ends where it cannot go on
        (people, "odeint", [50, 500], [0.03, 1.0]),
        (people, "fused_1", [50, 500, 1000], [1e-3, 6e-3, 1.2e-2]),
    ):
        np.testing.assert_array_equal(_line(ax, engine).get_xydata().T, [x, y])
    assert steps.get_title() == "n4: 34 sequences, 4 cars"
    assert people.get_title() == "sf: 1 sequence, 25 steps"
    (bars,) = {tuple(c[0].vertices[:, 1]) for c in [steps.collections[0].get_paths()]}
    np.testing.assert_allclose(bars, [0.018, 0.03])


def test_the_reference_is_proportional_and_below_all_points() -> None:
    (ax,) = _figure(*PEOPLE).axes
    x, y = _line(ax, "slope 1").get_xydata().T
    assert (x[0], x[-1]) == (50, 1000)
    assert y[1] / y[0] == x[1] / x[0]
    for engine in ("odeint", "fused_1"):
        for n, t in _line(ax, engine).get_xydata():
            assert t > n * y[0] / x[0]


def test_the_legend_names_what_is_drawn() -> None:
    (legend,) = _figure(*STEPS).legends
    assert [text.get_text() for text in legend.get_texts()] == [
        "torchdiffeq, discrete gradient",
        "fused, 1 thread",
        "fused, 2 threads",
        "slope 1",
    ]


def test_an_engine_without_a_look_is_drawn() -> None:
    figure = _figure(_row("steps", 4, 100, warp=1.0), _row("steps", 4, 200, warp=2.0))
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["warp", "slope 1"]


def test_nothing_to_draw() -> None:
    assert _figure() is None
    assert _figure(STEPS[0], STEPS[0], PEOPLE[0], _row("paper", 4, 600, odeint=1.0)) is None
    assert len(_figure(*STEPS, PEOPLE[0]).axes) == 1


def test_all_engines_differ_in_grey() -> None:
    assert set(LOOKS) == set(ENGINES)
    times = dict.fromkeys(LOOKS, 1.0)
    (ax,) = _figure(_row("steps", 4, 100, **times), _row("steps", 4, 200, **times)).axes
    looks = set()
    for name in LOOKS:
        line = _line(ax, name)
        looks.add((line.get_marker(), line.get_markerfacecolor() == "none"))
    assert len(looks) == len(LOOKS)


def test_a_diagnosis_over_sequences() -> None:
    rows = [
        {"shape": "diagnosis", "sequences": n, "wall_s": 0.2 * n, "peak_memory_MB": 500.0 + n}
        for n in (20, 100, 1000)
    ]
    (ax,) = _figure(*rows).axes
    np.testing.assert_allclose(_line(ax, "wall_s").get_ydata(), [4, 20, 200])
    np.testing.assert_allclose(_line(ax, "peak_memory_MB").get_ydata(), [0.52, 0.6, 1.5])
    assert [*_figure(*rows, *STEPS).axes[0].get_xlim()] != [*ax.get_xlim()]
    assert len(_figure(*rows, *STEPS).axes) == 2
    assert _figure(rows[0]) is None
