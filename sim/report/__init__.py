"""The report of a run: one HTML page with figures.  Where matplotlib is imported."""

import logging

# matplotlib keeps a list of fonts on disk.  Without room for that it works all the same; its warning would hide our one line.
logging.getLogger("matplotlib.font_manager").setLevel(logging.ERROR)
