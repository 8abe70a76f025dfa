"""Hypothesis draws the same examples in every run, and a loaded machine is no failure.  Matrices are small: one thread."""

import os

# Before numpy is imported: on a busy machine its threads wait for each other, a hundred times as long as they compute.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from hypothesis import settings

settings.register_profile("ci", derandomize=True, deadline=None, database=None)
settings.load_profile("ci")
