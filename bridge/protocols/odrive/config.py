"""The configuration of an axis, with the vendor's names and defaults; the plan overrides some of them."""

from dataclasses import dataclass

from echelon.bridge.protocols.odrive.enums import Command, ControlMode
from echelon.plan.can_plan import DrivePlan

_NS = 1_000_000


@dataclass(frozen=True, slots=True)
class ODriveConfig:
    """Fields of `axis0.config`, `axis0.config.can` and `axis0.controller.config` in the vendor's tool.

    Periods are in ms; 0 means: only on request.

    Raises ValueError for a negative period."""

    heartbeat_msg_rate_ms: int = 100
    error_msg_rate_ms: int = 100
    encoder_msg_rate_ms: int | None = None
    """None: the period of the plan"""
    iq_msg_rate_ms: int = 100
    temperature_msg_rate_ms: int = 100
    bus_voltage_msg_rate_ms: int = 100
    torques_msg_rate_ms: int | None = None
    """None: the period of the plan"""
    powers_msg_rate_ms: int = 0
    control_mode: ControlMode = ControlMode.POSITION_CONTROL
    """The mode after power-on (`axis0.controller.config.control_mode`); the input mode is PASSTHROUGH"""
    enable_watchdog: bool = True
    """The timeout of the watchdog is the plan's"""
    every_frame_feeds: bool = False
    """True: every accepted frame feeds the watchdog, as in firmware 0.5.6; False: torques and Set_Axis_State do"""

    def periods_ns(self, plan: DrivePlan) -> dict[Command, int]:
        """Returns the cyclic messages with their periods [ns], in the order in which they win arbitration."""
        rates = {
            Command.HEARTBEAT: self.heartbeat_msg_rate_ms,
            Command.GET_ERROR: self.error_msg_rate_ms,
            Command.GET_ENCODER_ESTIMATES: self.encoder_msg_rate_ms,
            Command.GET_IQ: self.iq_msg_rate_ms,
            Command.GET_TEMPERATURE: self.temperature_msg_rate_ms,
            Command.GET_BUS_VOLTAGE_CURRENT: self.bus_voltage_msg_rate_ms,
            Command.GET_TORQUES: self.torques_msg_rate_ms,
            Command.GET_POWERS: self.powers_msg_rate_ms,
        }
        for command, rate in rates.items():
            if rate is not None and rate < 0:
                raise ValueError(f"period of {command.name} must be 0 (never) or more ms, not {rate!r}")
        return {command: plan.period_ns if rate is None else rate * _NS for command, rate in rates.items() if rate != 0}
