"""The bridge and the virtual drives on real buses: in one process, in lockstep, on a wall clock."""
