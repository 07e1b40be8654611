"""Diagnosis: where a model is wrong, which effect is missing, and what adding it changes.

``diagnose`` compares laws and diagnoses the best-fitting and the requested one; ``single_law`` has
the steps for one law: calibration, location of deviations (``curves``), stepwise selection of
effects (``search``), their test on held-back clusters (``confirmation``), and the ``verdict``.
``residuals`` are those of a calibrated model, with engines in ``lanes`` and ``crowds``;
``statistics`` has tests and intervals, ``report`` the pages.
"""
