"""Diagnosis: where a model is wrong, which effect is missing, and what adding it changes.

The folders stand in the way that data go: what a calibrated model leaves (``residuals``, in
``lanes`` and ``crowds`` each in its own way), what of that is chance (``statistics``), where it is
wrong (``locate``), which effect it lacks (``name``), what may be said of it (``judge``), and the
pages (``report``).
"""
