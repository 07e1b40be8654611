"""Output of a run for TensorBoard."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from PIL import Image
from torch.utils.tensorboard import SummaryWriter


class Logbook(SummaryWriter):
    """Scalars, configuration and figures of a run, under ``folder``.

    Args:
        folder: folder of the TensorBoard run.
        config: the composed configuration.
        step: the step from which a resumed run writes; TensorBoard hides what the interrupted
            run wrote after it.
    """

    def __init__(self, folder: Path, config: dict[str, Any], step: int = 0) -> None:
        super().__init__(str(folder), purge_step=step + 1 if step else None)
        self._config = config
        if not step:
            text = json.dumps(config, indent=2, ensure_ascii=False)
            self.add_text("config", f"```\n{text}\n```", 0)

    def scalars(self, row: dict[str, float], step: int) -> None:
        """Write one value of every scalar in ``row``."""
        for name, value in row.items():
            self.add_scalar(name, value, step)

    def picture(self, name: str, path: Path, step: int) -> None:
        """Write an image file."""
        pixels = np.asarray(Image.open(path).convert("RGB"))
        self.add_image(name, pixels, step, dataformats="HWC")

    def result(self, values: dict[str, float]) -> None:
        """Write the options as hyperparameters, with the values that the run ended with."""
        (options,) = pd.json_normalize(self._config).to_dict("records")
        scalars = {
            str(name): value if isinstance(value, bool | int | float | str) else str(value)
            for name, value in options.items()
        }
        self.add_hparams(scalars, values, run_name=".")
