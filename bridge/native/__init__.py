"""The native protocol: both wheels of a robot in one frame, with counter and CRC."""
