"""The bridge and the virtual drives at work on a bus: in one process, in a lockstep, on a wall clock."""
