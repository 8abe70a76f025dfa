"""Models of a bus in time: arbitration, errors, queues, worst-case response times.  Pure."""
