"""A virtual CiA 402 drive: one CANopen node with the motor of one wheel, in mode 4 (profile torque) or 10 (cyclic torque).

state                     entered when                                        what the drive does
NOT READY TO SWITCH ON    at power-on or NMT reset                            boots, then SWITCH ON DISABLED
SWITCH ON DISABLED        after boot-up; disable voltage (00); quick stop     no power
                          from a lower state; a fault reset; OPERATION
                          ENABLED when NMT OPERATIONAL is left
READY TO SWITCH ON        shutdown (controlword 06)                           no power
SWITCHED ON               switch on (07)                                      no power
OPERATION ENABLED         enable operation (0F)                               follows the target torque, which starts at zero
QUICK STOP ACTIVE         quick stop (02) from OPERATION ENABLED              no power; stays with option codes 5 and 6 of
                                                                              605A, else goes on to SWITCH ON DISABLED
FAULT                     any fault, from any state, through FAULT            no power; a fault reset (80) leads to SWITCH ON
                          REACTION ACTIVE, which takes no time                DISABLED if the cause is gone

- Object 6071 is the target torque; 6072 limits it.  Ramps of a quick stop or of a fault reaction do not exist: the power stage
  is switched off at once.
- Watchdog: in OPERATION ENABLED, the RPDO that carries 6071 (RPDO2 if none does) must come within its event timer, otherwise
  there is a fault.  The event timer starts as the plan's watchdog.  Writing 6071 by SDO also feeds it.  Other RPDOs
  with an event timer are watched from their first frame on.
- After a fault, the drive refuses torques until the first zero.
- If the host's heartbeat is lost, object 6007 decides: 0 nothing, 1 a fault, 2 and 3 no power.  Such a fault cannot be reset
  before the host's heartbeat comes again.
"""

from typing import Final

from echelon.bridge.protocols.cia402 import objects
from echelon.bridge.protocols.cia402.codec import (
    AUTOMATIC,
    FAULT_CODES,
    FOLLOWS_COMMAND,
    HALT,
    INTERNAL_LIMIT,
    MODE_CYCLIC_TORQUE,
    MODE_NONE,
    MODE_PROFILE_TORQUE,
    REMOTE,
    VOLTAGE_ENABLED,
    ErrorCode,
    Nmt,
    State,
    check_node,
    emergency,
    milliseconds,
    newton_metres,
    next_state,
    permille,
    rated_mnm,
)
from echelon.bridge.protocols.cia402.node import Node
from echelon.bridge.protocols.cia402.objects import Live
from echelon.bridge.protocols.cia402.pdo import Pdo
from echelon.bridge.protocols.cia402.sdo import Key
from echelon.bridge.protocols.faults import LATCHING, ON_DEMAND, Fault
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.motor import Motor
from echelon.plan.can_plan import NEVER_NS, DrivePlan

MODES: Final = (MODE_NONE, MODE_PROFILE_TORQUE, MODE_CYCLIC_TORQUE)
_STAYS = (5, 6)
"""Quick stop option codes with which the drive stays in QUICK STOP ACTIVE."""


class Cia402Drive(Node):
    """The drive of one wheel (0 right, 1 left) of a robot.  Raises ValueError for another wheel, or a bad node id."""

    def __init__(self, plan: DrivePlan, wheel: int) -> None:
        if wheel not in (0, 1):
            raise ValueError(f"wheel must be 0 (right) or 1 (left), not {wheel!r}")
        motor = plan.motor
        self.plan = plan
        self.wheel = wheel
        self.motor = Motor(motor)
        self.motors: tuple[Motor, ...] = (self.motor,)
        self.state = State.NOT_READY_TO_SWITCH_ON
        self._rated = rated_mnm(motor.rated_torque)
        self._silent = False
        self._hold = False
        """True from a fault until the first zero torque after it."""
        self._errors: list[ErrorCode] = []
        self._controlword = 0
        self._limited = False
        self._mean, self._mean_ns = 0, -NEVER_NS
        values = {
            objects.MAX_TORQUE: min(0xFFFF, permille(motor.torque_limit, self._rated)),
            objects.RATED_TORQUE: self._rated,
            objects.RATED_CURRENT: round(self._rated / motor.torque_constant),
            objects.TORQUE_SLOPE: int(min(motor.torque_slew * 1e6 / self._rated, objects.Type.U32.high)),
            (objects.RPDO_COMMUNICATION + 1, objects.EVENT_TIMER): milliseconds(plan.watchdog_ns),
        }
        super().__init__(check_node(plan.node_ids[wheel]), values)
        self._od.live |= self._live()

    def _live(self) -> dict[Key, Live]:
        motor = self.motor
        return {
            objects.STATUSWORD: self._statusword,
            objects.MODE_DISPLAY: lambda: self._od[objects.MODE],
            objects.POSITION: lambda: motor.counts,
            objects.VELOCITY: lambda: round(motor.velocity * motor.plan.encoder_counts),
            objects.TORQUE_DEMAND: lambda: permille(motor.setpoint, self._rated),
            objects.TORQUE_ACTUAL: lambda: permille(motor.torque, self._rated),
            # current is proportional to torque, so it has the same value in thousandths of the rated current
            objects.CURRENT_ACTUAL: lambda: permille(motor.torque, self._rated),
            objects.DC_LINK_VOLTAGE: lambda: round(motor.bus_voltage * 1000),
            objects.TEMPERATURE: lambda: round(motor.temperature * 10),
        }

    def receive(self, time_ns: int, frame: Frame) -> list[Frame]:
        """Takes a frame; returns the immediate answers."""
        return self.advance(time_ns) if self._silent else super().receive(time_ns, frame)

    def inject(self, time_ns: int, wheel: int, fault: Fault) -> list[Frame]:
        """Makes a fault happen at its wheel.  Raises ValueError for another wheel, or a fault that only the bus can cause."""
        self._check(wheel, fault)
        out = self.advance(time_ns)
        if fault is Fault.SILENT:
            self._power_off(time_ns)
            self._silent, self.nmt = True, Nmt.BOOT_UP
            self._due.clear()
            return out
        self.motor.inject(time_ns, fault)
        if fault in LATCHING and self.nmt is not Nmt.BOOT_UP:
            self._fail(time_ns, FAULT_CODES[fault])
        return out + self.advance(time_ns)

    def mend(self, time_ns: int, wheel: int, fault: Fault) -> None:
        """Takes the cause of a fault away.  A latched fault stays until it is reset over the bus."""
        self._check(wheel, fault)
        self._pass(time_ns)  # the next call returns frames that are due before
        if fault is not Fault.SILENT:
            self.motor.mend(time_ns, fault)
        elif self._silent:
            self._silent = False
            self._power_on(time_ns)

    def _check(self, wheel: int, fault: Fault) -> None:
        if wheel != self.wheel:
            raise ValueError(f"this is the drive of wheel {self.wheel}, not {wheel!r}")
        if fault not in ON_DEMAND:
            raise ValueError(f"faults on demand are {', '.join(ON_DEMAND)}, not {fault!r}")

    # the profile of a node (profile.py)

    def _switch_on(self, time_ns: int) -> None:
        self._power_off(time_ns)
        self.motor.mean_torque(time_ns)
        self._hold = self._hold or bool(self._errors)
        self._errors.clear()
        self._controlword = 0
        self.state = State.NOT_READY_TO_SWITCH_ON

    def _booted(self, time_ns: int) -> None:
        if self.state is State.NOT_READY_TO_SWITCH_ON:
            self.state = AUTOMATIC[self.state]
        # causes from before the boot-up latch now
        for fault in sorted(self.motor.causes):
            self._fail(time_ns, FAULT_CODES[fault])

    def _physics(self, time_ns: int) -> None:
        fault = self.motor.advance(time_ns)
        if fault is not None and self.nmt is not Nmt.BOOT_UP:
            self._fail(time_ns, FAULT_CODES[fault])

    def _sample(self, time_ns: int, key: Key) -> int:
        if key != objects.TORQUE_ACTUAL:
            return self._od[key]
        if time_ns != self._mean_ns:
            self._mean, self._mean_ns = permille(self.motor.mean_torque(time_ns), self._rated), time_ns
        return self._mean

    def _allowed(self, key: Key, value: int) -> bool:
        return key != objects.MODE or value in MODES

    def _set(self, time_ns: int, key: Key, value: int) -> bool:
        if key == objects.CONTROLWORD:
            self._control(time_ns, value)
            return True
        if key == objects.TARGET_TORQUE:
            if self._hold and value:
                self.refused["first command not zero"] += 1
                return False
            if self.state is State.OPERATION_ENABLED:
                self._hold = False
                self._feed(time_ns)
        if key == objects.MODE and value != self._od[key]:
            self._od[objects.TARGET_TORQUE] = 0
        self._od[key] = value
        self._apply(time_ns)
        return True

    def _took(self, time_ns: int, pdo: Pdo) -> None:
        if self.state is State.OPERATION_ENABLED:
            self._set_due("rpdo", pdo.number, time_ns, pdo.timer_ns)

    def _missed(self, time_ns: int) -> None:
        self._fail(time_ns, ErrorCode.RPDO_TIMEOUT)

    def _rest(self, time_ns: int) -> None:
        if self.state in (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE):
            self._go(time_ns, State.SWITCH_ON_DISABLED)
        self.motor.mean_torque(time_ns)  # the next report is a mean from here on

    def _without_host(self, time_ns: int) -> None:
        option = self._od[objects.ABORT_CONNECTION]
        if option == 1:
            self._fail(time_ns, ErrorCode.HEARTBEAT)
            return
        if self.nmt is not Nmt.STOPPED:
            self._out.append(emergency(self.node, ErrorCode.HEARTBEAT, ErrorCode.HEARTBEAT.register))
        if option and self.state is State.OPERATION_ENABLED:
            self._go(time_ns, State.SWITCH_ON_DISABLED)

    # the state machine

    def _control(self, time_ns: int, word: int) -> None:
        state = next_state(self.state, word, self._controlword)
        self._controlword = self._od[objects.CONTROLWORD] = word
        if self.state is State.FAULT and state is not State.FAULT:
            if self._host_lost or self.motor.causes:
                self.refused["fault persists"] += 1
                return
            self._errors.clear()
            self._report(self._errors)
        if state is not self.state:
            self._go(time_ns, state)
        if self.state is State.QUICK_STOP_ACTIVE and self._od[objects.QUICK_STOP_OPTION] not in _STAYS:
            self._go(time_ns, AUTOMATIC[self.state])
        self._apply(time_ns)

    def _go(self, time_ns: int, state: State) -> None:
        self.state = state
        if state is State.OPERATION_ENABLED:
            self._od[objects.TARGET_TORQUE] = 0
            self._waiting.clear()
            self._feed(time_ns)
            self._apply(time_ns)
        else:
            self._power_off(time_ns)

    def _fail(self, time_ns: int, code: ErrorCode) -> None:
        """Enters FAULT, through FAULT REACTION ACTIVE, which takes no time."""
        self.state = AUTOMATIC[State.FAULT_REACTION_ACTIVE]
        self._hold = True
        self._power_off(time_ns)
        if code not in self._errors:
            self._errors.append(code)
            self._report(self._errors)

    def _power_off(self, time_ns: int) -> None:
        self.motor.cut(time_ns)
        self._limited = False
        self._od[objects.TARGET_TORQUE] = 0
        self._waiting.clear()
        self._drop_due("rpdo")

    def _feed(self, time_ns: int) -> None:
        """Restarts the watchdog of the target torque."""
        carriers = [pdo.number for pdo in self._rpdos.values() if objects.TARGET_TORQUE in pdo.keys] or [1]
        for number in carriers:
            timer = self._od[objects.RPDO_COMMUNICATION + number, objects.EVENT_TIMER]
            self._set_due("rpdo", number, time_ns, timer * 1_000_000)

    def _apply(self, time_ns: int) -> None:
        """Sets the motor's torque from the target torque, in OPERATION ENABLED."""
        if self.state is not State.OPERATION_ENABLED:
            return
        od = self._od
        mode, target, most = od[objects.MODE], od[objects.TARGET_TORQUE], od[objects.MAX_TORQUE]
        if mode == MODE_NONE or (mode == MODE_PROFILE_TORQUE and self._controlword & HALT):
            target = 0
        torque = newton_metres(max(-most, min(most, target)), self._rated)
        self._limited = abs(target) > most or abs(torque) > self.motor.limit
        self.motor.set_torque(time_ns, torque)

    def _statusword(self) -> int:
        word = self.state.bits | VOLTAGE_ENABLED
        if self.nmt is Nmt.OPERATIONAL:
            word |= REMOTE
        if self._limited:
            word |= INTERNAL_LIMIT
        if self.state is State.OPERATION_ENABLED and self._od[objects.MODE] == MODE_CYCLIC_TORQUE and not self._hold:
            word |= FOLLOWS_COMMAND
        return word
