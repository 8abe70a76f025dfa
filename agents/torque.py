"""The torque loop inside the robot: from a wanted acceleration to the torques of its wheels (theory.md section 1).

Inverse of the paper's plant (feedback linearisation): for a wanted p̈ = a,

    τ_r + τ_l = m1 r (e_v · a + d ω²)
    τ_r - τ_l = (J r/(d R)) (e_n · a - v ω)

B(θ) is singular only for d = 0, which no plan has.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import cos, sin

from echelon.agents.plant import RobotState
from echelon.plan.plan import RobotPlan

Inverse = Callable[[RobotState, float, float, float], tuple[float, float]]
"""(state, a_x, a_y [m/s²], lead [s]) → (τ_right, τ_left) [N m]."""


def make_inverse(robot: RobotPlan) -> Inverse:
    """Returns the inverse for a robot.

    Torque is held while the robot turns, so it is computed for the state `lead` from now, as the robot will be if it
    does what is wanted; with half a torque period for `lead` the first-order error of the hold goes (theory.md
    section 7).
    """
    m, d, r, arm = robot.mass, robot.offset, robot.wheel_radius, robot.arm
    half_sum = m * r / 2
    half_difference = (robot.inertia - m * d * d) * r / (d * arm) / 2

    def inverse(state: RobotState, ax: float, ay: float, lead: float) -> tuple[float, float]:
        _, _, theta, v, omega, c, s = state
        v_dot = c * ax + s * ay + d * omega * omega
        omega_dot = (c * ay - s * ax - v * omega) / d
        theta += lead * (omega + 0.5 * lead * omega_dot)
        v += lead * v_dot
        omega += lead * omega_dot
        c, s = cos(theta), sin(theta)
        total = half_sum * (c * ax + s * ay + d * omega * omega)
        difference = half_difference * (c * ay - s * ax - v * omega)
        return total + difference, total - difference

    return inverse


@dataclass(slots=True)
class TorqueLimits:
    """What the drives of a robot can do; keeps the last torques for the rate limit."""

    torque_limit: float
    torque_rate_limit: float
    wheel_speed_limit: float
    wheel_radius: float
    arm: float
    tau_right: float = 0.0
    tau_left: float = 0.0

    def apply(self, tau_right: float, tau_left: float, v: float, omega: float, h: float) -> tuple[float, float, bool]:
        """Returns the torques that the drives give for wanted ones over the next `h` [s], and whether any was limited.

        Order: rate, magnitude, then wheel speed (v ± R ω)/r: beyond its limit a motor gives none in its direction.
        Torques that are no numbers become zero, and count as limited.
        """
        limit, change, speed = self.torque_limit, self.torque_rate_limit * h, self.wheel_speed_limit * self.wheel_radius
        if not (
            -limit <= tau_right <= limit
            and -limit <= tau_left <= limit
            and -change <= tau_right - self.tau_right <= change
            and -change <= tau_left - self.tau_left <= change
            and abs(v) + self.arm * abs(omega) <= speed
        ):
            wanted = tau_right, tau_left
            tau_right = self._one(tau_right, self.tau_right, (v + self.arm * omega) / self.wheel_radius, change)
            tau_left = self._one(tau_left, self.tau_left, (v - self.arm * omega) / self.wheel_radius, change)
            self.tau_right, self.tau_left = tau_right, tau_left
            return tau_right, tau_left, (tau_right, tau_left) != wanted
        self.tau_right, self.tau_left = tau_right, tau_left
        return tau_right, tau_left, False

    def _one(self, wanted: float, last: float, wheel_speed: float, change: float) -> float:
        if wanted != wanted:
            return 0.0
        tau = min(max(wanted, last - change), last + change)
        tau = min(max(tau, -self.torque_limit), self.torque_limit)
        return 0.0 if abs(wheel_speed) > self.wheel_speed_limit and tau * wheel_speed > 0 else tau
