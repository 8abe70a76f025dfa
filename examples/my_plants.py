"""A plant: the paper's robot, whose wheels slip: the ground takes no more force from a wheel than its grip."""

from math import tanh

from echelon import Plant
from echelon.agents.plant import paper_step


class Slipping(Plant):
    grip: float = 6.0  # largest force between a wheel and the ground [N]

    def step(self, robot, state, tau_right, tau_left, h):
        most = self.grip * robot.wheel_radius
        return paper_step(robot)(state, most * tanh(tau_right / most), most * tanh(tau_left / most), h)
