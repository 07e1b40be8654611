"""The result of a diagnosis as an object."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import pandas as pd

from nnode.diagnosis.report.files import amount, closed, interval, plain_report, sentence
from nnode.diagnosis.result import Clusters, DataFault, Diagnosis, Gap, NamedEffect, Place
from nnode.errors import ConfigError
from nnode.files import xarray
from nnode.model import System

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from xarray import Dataset


@dataclass(frozen=True, kw_only=True, repr=False)
class Report:
    """The result of a diagnosis.

    Attributes:
        diagnosis: the whole result; the properties are its main parts.
        model: the calibrated model with the named effects.
        nearest: the report of the best law, if another one was diagnosed.
        draw: draws a figure by its name; None: the diagnosis was read, not made.
    """

    diagnosis: Diagnosis
    model: System
    nearest: Report | None = None
    draw: Callable[[str], Figure] | None = None

    @property
    def verdict(self) -> str:
        """``named``, ``none``, ``unknown``, ``indistinguishable`` or
        ``not_testable``."""
        return self.diagnosis.verdict

    @property
    def effects(self) -> list[NamedEffect]:
        """The effects that were added and confirmed."""
        return self.diagnosis.effects

    @property
    def hypotheses(self) -> list[NamedEffect]:
        """Hypotheses that were not confirmed."""
        return self.diagnosis.hypotheses

    @property
    def places(self) -> list[Place]:
        """Where the model deviates from the data."""
        return self.diagnosis.places

    @property
    def gap(self) -> Gap:
        """Errors on confirmation sequences, before and after."""
        return self.diagnosis.gap

    @property
    def clusters(self) -> Clusters:
        """Numbers and definition of independent clusters."""
        return self.diagnosis.clusters

    @property
    def data_faults(self) -> list[DataFault]:
        """Faults of the measurement; their sequences were excluded."""
        return self.diagnosis.data_faults

    @property
    def sentence(self) -> str:
        """The verdict in words."""
        return sentence(self.diagnosis)

    def plot(self, which: str = "map") -> Figure:
        """A figure of the page.

        Args:
            which: ``map``: measured minus simulated speed in space and time, or acceleration by
                position, before and after the effects were added; ``confirmation``: errors of the
                confirmation sequences, before and after; ``coefficients`` of the effects;
                ``where``: deviations by variable.

        Raises:
            ConfigError: an unknown figure, or a report without data.
        """
        if self.draw is None:
            raise ConfigError("this report has no data to draw; use the one of nnode.diagnose")
        return self.draw(which)

    def summary(self) -> str:
        """The verdict, the errors, the effects and the drivers as text."""
        d = self.diagnosis
        gap, noise = d.gap, amount(d.gap.noise_floor)
        lines = [
            self.sentence,
            "",
            f"{'Model':<36}{d.model}",
            f"{'Exploration clusters':<36}{d.clusters.exploration}",
            f"{'Confirmation clusters':<36}{d.clusters.confirmation}",
            f"{'Error before, confirmation (m²)':<36}{amount(gap.before)}",
            f"{'Error after, confirmation (m²)':<36}{amount(gap.after)}",
            f"{'Noise floor (m²)':<36}{noise}",
            f"{'Removed error above the noise floor':<36}{closed(d)}",
        ]
        for title, effects in (
            ("Effects", self.effects),
            ("Not confirmed", self.hypotheses),
        ):
            rows = [
                (f"{effect.name}.{name}", c.value, c.low, c.high, c.unit)
                for effect in effects
                for name, c in effect.coefficients.items()
            ]
            lines += _table(title, rows)
        drivers = [(v.name, v.estimate, v.lower, v.upper, v.unit) for v in d.drivers]
        lines += _table("Differences between drivers and disturbances", drivers)
        absent = [(a.name, a.detectable, a.unit) for a in d.absences if a.testable]
        if absent:
            lines += ["", "Not found; detectable strength with 80 % power"]
            lines += [f"{name:<28}{amount(size):>12}  {unit}" for name, size, unit in absent]
        return "\n".join(line.rstrip() for line in lines)

    def plain(self) -> dict[str, Any]:
        """The content of ``report.json``."""
        return plain_report(self.diagnosis)

    def to_dataframe(self) -> pd.DataFrame:
        """A row per coefficient of named effects and of hypotheses."""
        rows = [
            {
                "effect": effect.name,
                "named": named,
                "coefficient": name,
                "estimate": c.value,
                "lower": c.low,
                "upper": c.high,
                "unit": c.unit,
                "p_value": effect.p_value,
                "confirmed": effect.confirmed,
                "where": effect.where,
            }
            for effects, named in ((self.effects, True), (self.hypotheses, False))
            for effect in effects
            for name, c in effect.coefficients.items()
        ]
        columns = ["effect", "named", "coefficient", "estimate", "lower", "upper", "unit"]
        return pd.DataFrame(rows, columns=[*columns, "p_value", "confirmed", "where"])

    def to_xarray(self) -> Dataset:
        """:meth:`to_dataframe` along the dimension ``coefficient``, as ``effect.coefficient``.

        Needs xarray: ``pip install 'nnode[xarray]'``.
        """
        table = self.to_dataframe()
        table.index = pd.Index(table.pop("effect") + "." + table.pop("coefficient"))
        dataset: Dataset = xarray().Dataset.from_dataframe(table.rename_axis("coefficient"))
        return dataset.assign_attrs(verdict=self.verdict, model=self.diagnosis.model)

    def __repr__(self) -> str:
        lines = [f"{e.name}: {interval(e)}; {e.where}" for e in self.effects or self.hypotheses]
        return "\n".join([f"{self.verdict}: {self.sentence}", *(f"  {line}" for line in lines)])

    def _repr_html_(self) -> str:
        head = f"<p><b>{escape(self.verdict)}</b>: {escape(self.sentence)}</p>"
        table = self.to_dataframe()
        if table.empty:
            return head
        return head + table.to_html(index=False, float_format="{:.4g}".format, border=0)


def _table(title: str, rows: list[tuple[str, float, float, float, str]]) -> list[str]:
    """Lines of a titled table of estimates with 95 % intervals; empty without rows."""
    if not rows:
        return []
    heads = ["", "estimate", "[0.025", "0.975]", "unit"]
    cells = [(name, *(amount(value, 4) for value in values), unit) for name, *values, unit in rows]
    table = pd.DataFrame(cells, columns=heads)
    return ["", title, *table.to_string(index=False).splitlines()]
