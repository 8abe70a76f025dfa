"""`python -m bench`: measures the lockstep and other ways to run it, whole runs, and the CAN bus, one after the other."""

import argparse
import json
import sys
from dataclasses import asdict

from bench import batch, can, lockstep, product


def main() -> int:
    """Measures everything and prints it; returns the exit code: 1 if a peer failed, otherwise 0."""
    parser = argparse.ArgumentParser(prog="python -m bench", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--ticks", type=int, default=2000, help="ticks of a lockstep; slow peers run a fifth (default 2000)"
    )
    parser.add_argument("--repeat", type=int, default=5, help="runs of each kind (default 5)")
    parser.add_argument("--seconds", type=float, default=3.0, help="run time of scenarios as processes (default 3)")
    parser.add_argument("--json", action="store_true", help="print JSON instead of tables")
    options = parser.parse_args()
    machine = lockstep.machine()
    runs, failures = lockstep.compare(list(lockstep.PEERS), options.ticks, options.repeat)
    rows = product.measure(options.repeat, options.seconds) + can.measure(options.repeat, options.seconds)
    many, without = batch.measure(options.repeat)
    rows += many
    failures |= without
    if options.json:
        peers = {name: [asdict(one) for one in found] for name, found in runs.items()}
        print(json.dumps({"machine": machine, "peers": peers, "failures": failures, "runs": [asdict(r) for r in rows]}))
    else:
        print("  ".join(f"{key} {value}" for key, value in machine.items()), end="\n\n")
        print(lockstep.table(runs, failures), end="\n\n")
        print(product.table(rows))
        print(batch.told(without), end="")
    return 1 if any(text.startswith("failed") for text in failures.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
