"""Two runs on one bus are told apart at the start."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from echelon.bridge.can.bus_url import free_multicast_url
from echelon.bridge.can.claim import DRIVES, HOST, BusTakenError, Claim, is_claimed
from support.runs import ROOT, echelon


def test_a_bus_has_one_holder_at_a_time() -> None:
    url = free_multicast_url()
    with Claim(url, HOST):
        with pytest.raises(BusTakenError, match=f"another run is on this bus, process {os.getpid()}"):
            Claim(url, HOST)
        assert is_claimed(url, HOST)
        with Claim(url, DRIVES):  # the other side may be another process
            pass
    assert not is_claimed(url, HOST)


def test_groups_on_one_port_are_one_bus_and_interfaces_are_told_apart() -> None:
    port = free_multicast_url().rpartition(":")[2]
    with Claim(f"udp_multicast:239.1.1.1:{port}", HOST), Claim("socketcan:one", HOST), Claim("virtual:one", HOST):
        assert is_claimed(f"udp_multicast:[ff15::7]:{port}", HOST)
        assert [is_claimed(f"socketcan:{name}", HOST) for name in ("one", "two")] == [True, False]
        assert not is_claimed("virtual:one", HOST)  # a bus inside one process


def test_the_claim_of_a_process_that_is_killed_is_free() -> None:
    url = free_multicast_url()
    script = f"from echelon.bridge.can.claim import *; c = Claim({url!r}, HOST); print(flush=True); import time; time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, cwd=ROOT) as holder:
        assert holder.stdout is not None
        holder.stdout.readline()
        assert is_claimed(url, HOST)
        holder.kill()
    assert not is_claimed(url, HOST)


@pytest.mark.slow
@pytest.mark.parametrize("command", ["run", "drives"])
def test_the_second_on_a_bus_is_told_in_one_line_and_makes_no_folder(command: str, tmp_path: Path) -> None:
    url = free_multicast_url()
    out = ("--out", tmp_path / "run") if command == "run" else ()
    with Claim(url, HOST), Claim(url, DRIVES):
        done = echelon(command, "lab", "--can", url, *out)
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert (
        line
        == f"echelon: {url}: another run is on this bus, process {os.getpid()}; give another port or interface with --can"
    )
    assert not (tmp_path / "run").exists()
