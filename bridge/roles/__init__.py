"""The bridge and the virtual drives as roles, and the envelope."""
