"""A run as an MCAP file: writing, reading, recovering.  Only this folder imports mcap."""
