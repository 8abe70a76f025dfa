"""CAN buses and logs: sockets, URLs, files.  Only this folder imports python-can."""
