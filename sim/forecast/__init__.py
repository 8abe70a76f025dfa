"""Warnings about valid scenarios, before they are run: what is allowed, but probably not intended."""
