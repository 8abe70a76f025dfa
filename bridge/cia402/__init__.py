"""CiA 402 drives over CANopen: cyclic synchronous torque, one node for each wheel."""
