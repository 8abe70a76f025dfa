"""The torque loop inside the robot: from a wanted acceleration to wheel torques (docs/architecture.md, 2.1).

It is the inverse of the paper's plant (feedback linearisation).  For a wanted p̈ = a,

    τ_r + τ_l = m1 r (e_v · a + d ω²)
    τ_r - τ_l = (J r/(d R)) (e_n · a - v ω)

The input matrix B(θ) is singular only for d = 0, and no plan has d = 0.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import cos, sin

from echelon.agents.plant import RobotState
from echelon.plan.plan import RobotPlan

Inverse = Callable[[RobotState, float, float, float], tuple[float, float]]
"""(state, a_x, a_y [m/s²], lead [s]) → (τ_right, τ_left) [N m]"""


def make_inverse(robot: RobotPlan) -> Inverse:
    """Returns the inverse for a robot.

    Torque is held while the robot turns.  So the inverse is computed for the state after `lead` [s] under the wanted
    acceleration.  With half a torque period for `lead` this removes the first-order error of the hold (docs/architecture.md,
    2.1; numbers in 2.10).
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
    """The limits of a robot's wheel torques, in SI units.  It keeps the last torques for the rate limit."""

    torque_limit: float
    torque_rate_limit: float
    wheel_speed_limit: float
    wheel_radius: float
    arm: float
    tau_right: float = 0.0
    tau_left: float = 0.0

    def apply(self, tau_right: float, tau_left: float, v: float, omega: float, h: float) -> tuple[float, float, bool]:
        """Returns the limited torques for the wanted ones, and whether one was limited.  The last ones were held for `h` [s].

        The limits act in this order: rate of change, magnitude, wheel speed.  Beyond the limit of its speed (v ± R ω)/r a
        wheel gets no torque in its direction of motion.  A torque that is NaN becomes zero and counts as limited.
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
        """Returns the limited torque of one wheel; `change` is the largest change from `last` [N m]."""
        if wanted != wanted:
            return 0.0
        tau = min(max(wanted, last - change), last + change)
        tau = min(max(tau, -self.torque_limit), self.torque_limit)
        return 0.0 if abs(wheel_speed) > self.wheel_speed_limit and tau * wheel_speed > 0 else tau
