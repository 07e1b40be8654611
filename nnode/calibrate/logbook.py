"""Output of a run for TensorBoard."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image
from torch.utils.tensorboard import SummaryWriter

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def flatten(config: dict[str, Any], prefix: str = "") -> dict[str, bool | int | float | str]:
    """Nested options as ``{"group.option": scalar}``; lists and nulls become text."""
    flat: dict[str, bool | int | float | str] = {}
    for key, value in config.items():
        if isinstance(value, dict):
            flat.update(flatten(value, f"{prefix}{key}."))
        else:
            flat[prefix + key] = (
                value if isinstance(value, bool | int | float | str) else str(value)
            )
    return flat


class Logbook:
    """Scalars, configuration and figures of a run, under ``folder``.

    Args:
        folder: folder of the TensorBoard run.
        config: the composed configuration.
        step: the step from which a resumed run writes; TensorBoard hides what the interrupted
            run wrote after it.
    """

    def __init__(self, folder: Path, config: dict[str, Any], step: int = 0) -> None:
        self.folder = folder
        self._config = config
        self._writer = SummaryWriter(str(folder), purge_step=step + 1 if step else None)
        if not step:
            text = json.dumps(config, indent=2, ensure_ascii=False)
            self._writer.add_text("config", f"```\n{text}\n```", 0)

    def scalars(self, row: dict[str, float], step: int) -> None:
        """Write one value of every scalar in ``row``."""
        for name, value in row.items():
            self._writer.add_scalar(name, value, step)

    def figure(self, name: str, figure: Figure, step: int) -> None:
        """Write a figure."""
        self._writer.add_figure(name, figure, step)

    def picture(self, name: str, path: Path, step: int) -> None:
        """Write an image file."""
        self._writer.add_image(
            name, np.asarray(Image.open(path).convert("RGB")), step, dataformats="HWC"
        )

    def text(self, name: str, text: str) -> None:
        """Write a text in Markdown."""
        self._writer.add_text(name, text, 0)

    def close(self, result: dict[str, float] | None = None) -> None:
        """Write the hyperparameters with the final ``result``, and close the files."""
        if result:
            self._writer.add_hparams(flatten(self._config), result, run_name=".")
        self._writer.close()
