"""Diagnosis: where a model is wrong, which effect is missing, and what adding it changes.

The folders follow the data: the residuals of a calibrated model (``residuals``, with engines in
``lanes`` and ``crowds``), tests and intervals (``statistics``), where the model deviates from the
data (``locate``), the stepwise selection of effects (``name``), their confirmation and the verdict
(``judge``), and the pages (``report``).
"""
