"""The process `observers`: it receives copies of all messages of a run and gives them on to those who may only read."""

from multiprocessing.connection import Connection

from echelon.messages import Channel, Message
from echelon.runtime.session import Receive, Session
from echelon.runtime.wire import data_key, encode
from echelon.sim.observing import gate_token
from echelon.sim.processes.contract import ProcessSpec, StartError, finish, hear_finish, meet
from echelon.sim.processes.watch import Watch
from echelon.sim.processes.watchers import HIGH_WATER, PROGRESS_S, Reception
from echelon.sim.recording.time_order import speakers


def run_observers(spec: ProcessSpec, session: Session, control: Connection, watch: Watch) -> None:
    """Gives on all messages but frames, which can be heard on the buses, each under the key of its member and channel.

    They go through a session of their own, which drops what an observer does not take."""
    plan, gate = spec.plan, spec.gate
    assert gate is not None
    reception = Reception(spec, session, speakers(plan, spec.virtual, bool(spec.can_urls)), HIGH_WATER)
    paths = {one.index: one.path for one in plan.all_roles}
    puts: dict[tuple[int, Channel], Receive] = {}
    try:
        outside = Session(listen=[gate.endpoint], connect=[], lockstep=False, credentials=gate.credentials)
    except ValueError as error:
        raise StartError(str(error)) from None

    def give(messages: list[Message]) -> None:
        for message in messages:
            if message.channel is not Channel.FRAMES:
                at = message.source, message.channel
                if at not in puts:
                    puts[at] = outside.publisher(data_key(spec.run, paths[message.source], message.channel)).put
                puts[at](encode(message))

    with outside:
        outside.declare_token(gate_token(spec.run))
        reception.begin(meet(spec, session, control))
        order = None
        while order is None:
            watch.pulse.at_work(PROGRESS_S)
            give(reception.take(PROGRESS_S / 2))
            order = hear_finish(control)
        watch.pulse.rest()
        for messages in reception.drain(order.messages):
            give(messages)
        finish(spec, control, refusals=reception.refusals)  # before closing, which waits for observers that stand still
