"""The report of a run: one HTML page with figures.  Where matplotlib is imported."""
