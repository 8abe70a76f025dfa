"""What a plan is as arrays: one record for the run, and one for each robot, node, block, stream and link.

Matrices and lists of any length are in two pools: `table` of floats and `indices` of integers.  A field that ends in `_at` says
where in a pool, or where in the scratch of a run, its part begins.  -1 means that there is none.  No field has the name of an
attribute of numpy's scalars, such as `size`: uncompiled code would get that.

The scratch of a run is two arrays: `real` of floats and `whole` of integers.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

_FLOAT: Final = "f8"
_INT: Final = "i8"


def _record(wholes: str, reals: str) -> np.dtype[np.void]:
    names = [(name, _INT) for name in wholes.split()] + [(name, _FLOAT) for name in reals.split()]
    return np.dtype(names, align=True)  # what is not said to be aligned is read byte by byte on a GPU


RUN: Final = _record(
    # instants [ns]; whether robots avoid each other; law and trajectory (below), the trajectory's numbers in `table`
    "duration_ns tick_ns common_ns avoidance law trajectory trajectory_at trajectory_legs fractions_at fractions "
    # scratch: instants at which robots, then nodes, are due; places of robots and nodes, and their velocities; places of robots
    # before, and their order (potential); square of the smallest distance; a distance that no two robots are below;
    # the pair and its instant, then the number of violations; references of `REFERENCES` instants, and these (late_states)
    "due_at places_at rates_at before_at order_at distance_at apart_at closest_at references_at references_ns_at "
    # number of places in `whole` that are zero at the start
    "zeros "
    # from when on amplitudes are summed up: the last three sixths of the run [ns]
    "sooner_ns earlier_ns last_ns",
    # `ahead`: how far the feed-forward is led [s]; ticks in a nanosecond
    "avoidance_radius sensing_radius force_limit floor gamma beta kappa ahead per_tick",
)
ROBOT: Final = _record(
    # `at`: its state in `real`, `place`: its position; `command`: place of its acceleration in its leader's COMMAND; whether
    # its STATE has its own
    "period_ns torque_period_ns torque_periods plant limited on_arrival at place stream link command says_acceleration",
    # plant and inverse (agents.plant, agents.torque); lever to always: of the rigid body
    "h per_sum per_difference offset half_sum half_difference lever pull_x pull_y drag turn_drag always "
    "per_offset torque_limit torque_rate_limit speed_limit arm x y heading",
)
NODE: Final = _record(
    # whether it waits for its inputs; number of children and of robots below; in `table` w_k/(w_1 + … + w_k) and 1/w_k of each
    # child k; in `indices` links from the children, their indices (and the first, if each is one more than the one before, else
    # -1), the bounds of their robots, each robot's child, and what of their messages is carried up
    "period_ns parent_period_ns when_heard count robots shares_at means_at links_at children_at first_child bounds_at "
    "child_of_at carried_at "
    # streams that it sends, the link from its parent, and places in its parent's REFERENCE
    "up reference command link acceleration parent_rates parent_forces "
    # its block, and its desired shape in `table`; scratch: s, e, acceleration of its centroid, η, accelerations, F_pot, forces,
    # and its robots in order (potential)
    "block desired_at s_at e_at c_at eta_at a_at f_pot_at forces_at order_at "
    # its GROUP_STATE, whether it has one, when it acted last, and places in its GROUP_STATE
    "state_at has_state_at acted_at own_rates centroid_rates rates rates_size positions "
    # its last mask + 1 commands, each `COMMAND_REALS` of each child, then for each child the command that acted when its
    # message in use was sent and the one before; in `whole` the number of commands, their instants, then for each child the
    # number of that command and the instants of both; in `indices` the smallest delays of commands
    "commands_at commands_marks_at commands_mask command_delays_at",
    "",
)
BLOCK: Final = _record(
    # number of its rows; gains in `table`, diagonals only where `is_diagonal`; W K̄ as sparse rows: bounds and columns in
    # `indices`, values in `table`
    "rows is_diagonal k1_at k2_at ki_at pot_at rows_at values_at integral_at measures_at marks_at response_ns",
    # α and 1/ω² of its amplitude (sim.results.rates), 0 if it does not oscillate
    "sigma ahead period bound alpha per_omega_squared",
)
STREAM: Final = _record(
    # a role's messages on one channel: the last mask + 1 of them, of `length` values each from `at` in `real`; in `whole` their
    # number so far, then of each its stamp and whether it is null
    "length mask at marks_at",
    "",
)
LINK: Final = _record(
    # its stream, as above; `at`: the message in use in `real`, `zeros_at`: what is used where it is too old (policy `zero`);
    # places and sizes of the parts that the receiver uses of a message
    "length mask stream_at stream_marks_at prompt timeout_ns end_ns at zeros_at marks_at "
    # how a late state is brought to the present (below), whether it is a robot's, whether clocks are wrong
    "brought of_robot odd_clocks "
    # ages of what is used: a hash table of mask + 1 slots, and bins, in `whole` (ages)
    "ages_at ages_mask bins bins_at "
    "first_1 size_1 first_2 size_2 first_3 size_3 "
    # fates: all delays the same; how they are told, bounds; in `indices` tables, instants, blackouts; correlation
    "fixed kind delay_min_ns delay_span_ns table_at table_size times_at normal_at rho rest windows_at windows "
    "bursts loss_of_message fifo source_offset_ns receiver_offset_ns",
    "loss duplicates to_bad to_good share_bad loss_good loss_bad source_drift receiver_drift",
)

PAPER, BODY = 0, 1
"""`ROBOT.plant`"""
LINEAR, INTEGRAL, SLIDING = 0, 1, 2
"""`RUN.law`"""
LINE, CIRCLE, SINE, WAYPOINTS = 0, 1, 2, 3
"""`RUN.trajectory`"""

AS_THEY_ARE, WITH_REFERENCE, EXTRAPOLATED, PREDICTED = 0, 1, 2, 3
"""`LINK.brought`"""
COMMAND_REALS: Final = 6
"""Of one child: acceleration, and velocity and displacement since run time 0 due to earlier commands"""

REFERENCES: Final = 64
"""Instants of which the reference is kept"""

# Places in a robot's part of `real`.  Its position is among those of all robots.
THETA, V, OMEGA, COS, SIN, TAU_RIGHT, TAU_LEFT, HELD_S = range(8)
"""... torques last held, and how long they were held [s]"""
P_RIGHT, P_LEFT, P_PEAK, P_SATURATED, P_PART = range(8, 13)
"""Of the period so far, in torque periods: sums of the torques' squares, largest torque, torque periods in which a limit acted;
whether one acted in an earlier part of the present torque period"""
S_RIGHT, S_LEFT, S_PEAK, S_SATURATED, S_LATE, S_PERIODS = range(13, 19)
"""The same of all periods so far, squares as means; those after the first second; number of periods"""
A_X, A_Y = 19, 20
"""The acceleration that it follows [m/s²]"""
ROBOT_REALS: Final = 21

DRAWN, TABLE, TABLE_Z, BY_NUMBER, BY_TIME = range(5)
"""`LINK.kind`: uniform, a table of independent or of correlated delays, a trace"""

# Places in a link's part of `whole`.
TAKEN, IN_USE, STAMP, IS_NULL, LAST, LOST, DELIVERED, DUPLICATES, USED, HELD, AGE_SUM, AGE_MAX = range(12)
NEXT, HEARD, LATEST, KEY_0, KEY_1, KEY_2, KEY_3, BAD, Z = range(12, 21)
"""... when the next message arrives that is newer than the one in use, when the receiver looked last, latest arrival so far"""
F_OWN, F_LOSS, F_COPY, F_BURST = 21, 25, 29, 33
"""Draws of two messages"""
AGED, AGES, AGE_P50, AGE_P95, AGE_P99 = range(37, 42)
"""Uses of messages older than the instant; number of their different ages, -1 if there are too many; percentiles (ages)"""
LINK_WHOLES: Final = 42
"""After these come the arrivals of the newest messages [ns], `FAR` for those that are lost or arrive after the end of the run,
then those of their second copies"""
COUNTS: Final = (TAKEN, DELIVERED, LOST, DUPLICATES, USED, HELD, AGE_SUM, AGE_MAX, AGE_P50, AGE_P95, AGE_P99)
"""What of these is a result"""
GONE: Final = -1
"""The delay of a message that is lost"""
FAR: Final = 1 << 62
"""An instant that never comes [ns]"""

# Places in a block's part of `real` and of `whole`.
M_LAST, M_PEAK, M_START, M_ISE, M_IAE, M_ITAE, M_SOONER, M_EARLIER, M_FINAL = range(9)
"""... sums of the squared amplitude in each of the last three sixths of the run"""
BLOCK_REALS: Final = 9
M_PEAK_NS, M_FINITE, M_OUT_FLOOR = range(3)
BLOCK_WHOLES: Final = 3
"""After these comes for each fraction the last instant at which |e| was outside of it [ns]"""


class Model(NamedTuple):
    """A plan as arrays."""

    run: NDArray[np.void]
    robots: NDArray[np.void]
    nodes: NDArray[np.void]
    blocks: NDArray[np.void]
    streams: NDArray[np.void]
    links: NDArray[np.void]
    table: NDArray[np.float64]
    indices: NDArray[np.int64]
