"""Writes a trace of one-way delays as a busy wireless network has them: `python wifi_trace.py > wifi.csv`.

It is a model, not a measurement.  A message waits for the channel, is sent, and is sent again after a collision, with a
back-off that doubles (IEEE 802.11, distributed coordination function).  The channel is calm or busy:

    state    a try collides    other traffic before each try     lasts, in the mean
    -------  ----------------  --------------------------------  ------------------
    calm     5 %               exponential, mean 0.5 ms          120 messages
    busy     60 %              exponential, mean 20 ms           40 messages

Back-off before try k: a whole number of slots of 9 µs, evenly distributed below 16 · 2^k, at most 1024.  A try takes 0.4 ms.
After 7 tries the message is lost.  0.8 ms are for the ways through both hosts.  The numbers come from one seed, so the file is
the same on every machine.
"""

from random import Random

MESSAGES, SEED = 2400, 11
SLOT, TRY, HOSTS = 9e-6, 0.4e-3, 0.8e-3
COLLIDES, WAITS, STAYS = (0.05, 0.6), (0.5e-3, 20e-3), (1 - 1 / 120, 1 - 1 / 40)
TRIES = 7


def delays(seed: int = SEED, messages: int = MESSAGES) -> list[float | None]:
    """Returns the delays [s] of messages one after the other; None for one that is lost."""
    random, busy = Random(seed), True  # the formation starts in a busy time
    found: list[float | None] = []
    for _ in range(messages):
        busy = busy if random.random() < STAYS[busy] else not busy
        delay, arrives = HOSTS, False
        for number in range(TRIES):
            delay += random.expovariate(1 / WAITS[busy]) + random.randrange(min(16 << number, 1024)) * SLOT + TRY
            if random.random() >= COLLIDES[busy]:
                arrives = True
                break
        found.append(delay if arrives else None)
    return found


def text(found: list[float | None]) -> str:
    """Returns the lines of a trace."""
    head = "# one-way delays [s] of a busy wireless network; a model, made by examples/wifi_trace.py\n"
    return head + "".join("lost\n" if delay is None else f"{delay:.6f}\n" for delay in found)


if __name__ == "__main__":
    print(text(delays()), end="")
