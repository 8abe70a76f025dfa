"""Control laws: their base class (`law`), and the built-in laws."""

from typing import Final

from echelon.controller.laws.integral import Integral
from echelon.controller.laws.law import Block, Law, LinearGains
from echelon.controller.laws.linear import Linear
from echelon.controller.laws.terminal_sliding import TerminalSliding
from echelon.plugins import Plugin

LAWS: Final[dict[str, type[Plugin]]] = {
    "linear": Linear,
    "integral": Integral,
    "terminal_sliding": TerminalSliding,
}
"""The built-in laws by name."""

__all__ = ["LAWS", "Block", "Integral", "Law", "Linear", "LinearGains", "TerminalSliding"]
