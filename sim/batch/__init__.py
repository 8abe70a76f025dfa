"""The batch engine: many runs of a plan at once, as arrays, compiled, on all cores (docs/architecture.md, 3.8)."""
