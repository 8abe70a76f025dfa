"""The batch engine: many runs of a plan as arrays, compiled, on all cores (docs/architecture.md, 3.5)."""
