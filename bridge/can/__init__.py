"""CAN buses and logs: sockets, URLs, files.  Where python-can is imported."""
