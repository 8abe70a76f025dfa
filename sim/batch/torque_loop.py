"""The usual torque loop of a robot (agents.torque_loop), compiled; its arithmetic is that of Python to the last bit.

To import this module compiles the loop, or loads what is kept of an earlier process.  So processes that are forked later have
it at once.  Where it cannot be compiled the import raises ImportError; a fork server then goes on without it.
"""

from typing import Final

from echelon.agents.plant import state_at
from echelon.agents.torque_loop import Loop
from echelon.agents.torque_loop import usual as as_python
from echelon.sim.batch.compiled import compiled

try:
    usual: Final[Loop] = compiled(as_python)
    """`echelon.agents.torque_loop.usual`"""
    usual(0, state_at(0.0, 0.0, 0.0, 0.0, 0.0), (0.0,) * 3, (0.0,) * 3, (0.0,) * 10)
except Exception as error:  # what the compiler raises changes from version to version
    raise ImportError(f"the torque loop cannot be compiled: {error}") from error
