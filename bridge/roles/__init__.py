"""The bridge and the drives as roles, and the gate before the bus."""
