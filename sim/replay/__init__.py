"""Recordings judged: their messages fed to today's roles, and the messages of two runs compared.  Pure."""
