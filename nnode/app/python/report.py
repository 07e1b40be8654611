"""What a diagnosis found, as an object."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import pandas as pd

from nnode.discover.report.files import interval, plain_report, sentence
from nnode.discover.result import Clusters, DataFault, Diagnosis, Gap, NamedEffect, Place
from nnode.files import xarray
from nnode.model import System

if TYPE_CHECKING:
    from xarray import Dataset


@dataclass(frozen=True, kw_only=True, repr=False)
class Report:
    """What a model lacks.

    Attributes:
        diagnosis: all that was found; the properties are its most asked parts.
        model: the model with what was named, calibrated; without, the calibrated model alone.
        nearest: the same of the law that comes nearest, where another one was asked for.
    """

    diagnosis: Diagnosis
    model: System
    nearest: Report | None = None

    @property
    def verdict(self) -> str:
        """``named``, ``none``, ``unknown``, ``indistinguishable``, ``unconfirmed`` or
        ``not_testable``."""
        return self.diagnosis.verdict

    @property
    def effects(self) -> list[NamedEffect]:
        """What was added, and confirmed on sealed clusters."""
        return self.diagnosis.effects

    @property
    def leads(self) -> list[NamedEffect]:
        """What was found, and not confirmed."""
        return self.diagnosis.leads

    @property
    def places(self) -> list[Place]:
        """Where simulation and measurement part."""
        return self.diagnosis.places

    @property
    def gap(self) -> Gap:
        """Errors on sealed sequences, before and after."""
        return self.diagnosis.gap

    @property
    def clusters(self) -> Clusters:
        """What is independent of what."""
        return self.diagnosis.clusters

    @property
    def data_faults(self) -> list[DataFault]:
        """Faults of the measurement that were left out."""
        return self.diagnosis.data_faults

    @property
    def sentence(self) -> str:
        """The verdict in words."""
        return sentence(self.diagnosis)

    def plain(self) -> dict[str, Any]:
        """The content of ``report.json``."""
        return plain_report(self.diagnosis)

    def to_dataframe(self) -> pd.DataFrame:
        """A row per coefficient of what was named, and of what was not confirmed."""
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
            for effects, named in ((self.effects, True), (self.leads, False))
            for effect in effects
            for name, c in effect.coefficients.items()
        ]
        columns = ["effect", "named", "coefficient", "estimate", "lower", "upper", "unit"]
        return pd.DataFrame(rows, columns=[*columns, "p_value", "confirmed", "where"])

    def to_xarray(self) -> Dataset:
        """The same along ``coefficient``, as ``effect.coefficient``.

        Needs xarray: ``pip install 'nnode[xarray]'``.
        """
        table = self.to_dataframe()
        table.index = pd.Index(table.pop("effect") + "." + table.pop("coefficient"))
        found: Dataset = xarray().Dataset.from_dataframe(table.rename_axis("coefficient"))
        return found.assign_attrs(verdict=self.verdict, model=self.diagnosis.model)

    def __repr__(self) -> str:
        lines = [f"{e.name}: {interval(e)}; {e.where}" for e in self.effects or self.leads]
        return "\n".join([f"{self.verdict}: {self.sentence}", *(f"  {line}" for line in lines)])

    def _repr_html_(self) -> str:
        head = f"<p><b>{escape(self.verdict)}</b>: {escape(self.sentence)}</p>"
        table = self.to_dataframe()
        if table.empty:
            return head
        return head + table.to_html(index=False, float_format="{:.4g}".format, border=0)
