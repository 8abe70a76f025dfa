"""ODrive's CANSimple, as its firmware 0.6 speaks it: one node for each wheel."""
