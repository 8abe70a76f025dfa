"""Studies: sweeps with predictions, figures and a finding (docs/studies.md)."""
