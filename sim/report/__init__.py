"""The report of runs: one HTML page with figures.  Only this folder imports matplotlib."""

import logging

# matplotlib stores a list of fonts on disk.  It works without it, too; on a full disk its warning would hide our own message.
logging.getLogger("matplotlib.font_manager").setLevel(logging.ERROR)
