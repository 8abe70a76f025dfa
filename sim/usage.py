"""What a command raises for a mistake of its user's."""


class UsageError(Exception):
    """A mistake of the user's; the text is one line."""
