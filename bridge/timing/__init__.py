"""A bus in time: arbitration, errors, queues, worst-case waits; nothing here waits or does input or output."""
