"""`python -m chaos`: carries out chaos plans, one after the other, and says which promises were not kept."""

import argparse
import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from chaos import room
from chaos.checker import check
from chaos.plans import KINDS, ChaosPlan, draw
from chaos.subject import scenario
from chaos.trial import carry_out

PLANS: Final = 500
FOUND: Final = "found.json"
REFERENCES: Final = "ECHELON_CHAOS_REFERENCES"
"""Environment variable: the folder of undisturbed runs"""
TIMEOUT_S: Final = 400
"""How long a plan may take with all that is around it [s]"""
ENDING_S: Final = 10
"""How long it may take to end its run when it is broken off [s]"""


@dataclass(frozen=True, slots=True)
class Found:
    """What was found of a plan."""

    violations: list[str]
    outcome: str
    missed: int = 0
    """Datagrams that the listener could not take"""
    carried_out: int = 0
    """How many of its hits found their target"""


def options(words: Sequence[str] | None = None) -> argparse.Namespace:
    """Returns the options of the command line."""
    parser = argparse.ArgumentParser(prog="python -m chaos", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--plans", type=int, default=PLANS, help=f"how many plans (default {PLANS})")
    parser.add_argument("--from", type=int, default=0, dest="first", help="seed of the first one (default 0)")
    parser.add_argument("--seed", type=int, help="carry out the plan of this seed only, and keep its folder")
    parser.add_argument("--short", action="store_true", help="one hit for each run, and none that lasts for long")
    parser.add_argument("--kinds", default=",".join(KINDS), help=f"kinds of hits (default: all: {', '.join(KINDS)})")
    parser.add_argument("--list", action="store_true", help="print the plans only")
    parser.add_argument("--keep", type=Path, help="folder for the evidence of plans that fail (default: it is deleted)")
    parser.add_argument("--judge", type=Path, help="judge kept evidence again: the folder of a plan")
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)  # the folder of a plan in a process of its own
    told = parser.parse_args(words)
    told.kinds = tuple(told.kinds.split(","))
    if unknown := set(told.kinds) - set(KINDS):
        parser.error(f"--kinds: unknown {', '.join(sorted(unknown))}; known: {', '.join(KINDS)}")
    return told


def repeat(plan: ChaosPlan, kinds: tuple[str, ...], short: bool) -> str:
    """Returns the command that carries out one plan again."""
    words = f"--seed {plan.seed}" + (" --short" if short else "")
    words += "" if kinds == KINDS else f" --kinds {','.join(kinds)}"
    return f"make chaos ARGS='{words}'"


def reference(plan: ChaosPlan) -> Path | None:
    """Returns the recording of a plan's run in one process, which is made once for all plans with this run."""
    if plan.clock == "wall":
        return None
    folder = Path(os.environ[REFERENCES]) / f"{plan.path}-{plan.robots}"
    if not (folder / "run.mcap").exists():
        words = [sys.executable, "-m", "echelon", "run", "-", "--engine", "inprocess", "--can", "virtual", "--quiet"]
        words += ["--no-report", "--out", str(folder)]
        done = subprocess.run(words, input=scenario(plan), text=True, capture_output=True, check=False)
        if done.returncode not in (0, 1):
            raise RuntimeError(f"the undisturbed run of {plan} could not be made: {done.stderr}")
    return folder / "run.mcap"


def carry_out_here(plan: ChaosPlan, folder: Path) -> None:
    """Carries out a plan in this process and writes the evidence, and what was found, into its folder."""
    evidence = carry_out(plan, folder, reference(plan))
    (folder / "evidence.pickle").write_bytes(pickle.dumps(evidence))
    told = Found(
        violations=[str(violation) for violation in check(evidence)],
        outcome=f"exit code {evidence.code} {evidence.summary['verdict']['word'] if evidence.summary else ''}".rstrip(),
        missed=evidence.heard.missed,
        carried_out=len(evidence.done),
    )
    (folder / FOUND).write_text(json.dumps(asdict(told), indent=1) + "\n")


def carry_out_apart(plan: ChaosPlan, folder: Path, references: Path, kinds: tuple[str, ...], short: bool) -> Found:
    """Carries out a plan in a process of its own, in a room if it needs one; returns what was found.

    `references` is a folder for undisturbed runs, which plans share."""
    words = [sys.executable, "-m", "chaos", "--one", str(folder), "--seed", str(plan.seed), "--kinds", ",".join(kinds)]
    words += ["--short"] if short else []
    in_room = plan.needs_room and room.why_none() is None
    environment = os.environ | {REFERENCES: str(references), "OPENBLAS_NUM_THREADS": "1"}
    words = room.enter(words) if in_room else words
    with subprocess.Popen(words, start_new_session=True, env=environment) as process:
        try:
            process.wait(TIMEOUT_S)
        except BaseException as error:
            os.killpg(process.pid, signal.SIGINT)  # it ends the run, which has a session of its own
            with suppress(subprocess.TimeoutExpired):
                process.wait(ENDING_S)
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            if not isinstance(error, subprocess.TimeoutExpired):
                raise
            return Found([f"harness: it did not end within {TIMEOUT_S} s"], "none")
    if process.returncode:
        return Found([f"harness: it ended with exit code {process.returncode}"], "none")
    return Found(**json.loads((folder / FOUND).read_text()))


def main(words: Sequence[str] | None = None) -> int:
    """Carries out plans and prints what was found; returns the exit code: 1 if a promise was not kept."""
    told = options(words)
    if told.one is not None:
        carry_out_here(draw(told.seed, told.kinds, short=told.short), told.one)
        return 0
    if told.judge is not None:
        again = check(pickle.loads((told.judge / "evidence.pickle").read_bytes()))
        print("\n".join(map(str, again)) or "all promises were kept")
        return 1 if again else 0
    seeds = [told.seed] if told.seed is not None else range(told.first, told.first + told.plans)
    plans = [draw(seed, told.kinds, short=told.short) for seed in seeds]
    if told.list:
        print(*plans, sep="\n")
        return 0
    if (why := room.why_none()) is not None:
        print(
            f"NO NAMESPACES HERE ({why}): nothing is sent from another host, and disks are limits of files",
            file=sys.stderr,
        )
    failed: list[ChaosPlan] = []
    keep = told.keep or (Path(tempfile.mkdtemp(prefix="chaos-")) if told.seed is not None else None)
    begun_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="chaos-") as work:
        for number, plan in enumerate(plans, 1):
            folder = Path(work) / f"plan-{plan.seed}"
            found = carry_out_apart(plan, folder, Path(work) / "references", told.kinds, told.short)
            minutes = (time.monotonic() - begun_s) / 60
            missed = f", {found.missed} datagrams not heard" if found.missed else ""
            beside = "" if found.carried_out == len(plan.hits) else f", {found.carried_out} of {len(plan.hits)} hits"
            print(f"{number}/{len(plans)} {minutes:.1f} min  {plan}  →  {found.outcome}{beside}{missed}", flush=True)
            if found.violations:
                failed.append(plan)
                print(*(f"    {violation}" for violation in found.violations), sep="\n")
                print(f"    again: {repeat(plan, told.kinds, told.short)}", flush=True)
            if keep is not None and folder.exists() and (found.violations or told.seed is not None):
                keep.mkdir(parents=True, exist_ok=True)  # else a move would copy, which sockets do not bear
                shutil.rmtree(keep / folder.name, ignore_errors=True)
                shutil.move(folder, keep / folder.name)
                print(f"    its evidence: {keep / folder.name}", flush=True)
            shutil.rmtree(folder, ignore_errors=True)
    print(f"{len(plans) - len(failed)} of {len(plans)} plans kept all promises")
    for plan in failed:
        print(f"  {repeat(plan, told.kinds, told.short)}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
