"""Which network interfaces are hardware: all that the kernel does not call vcan or vxcan."""

import shutil
import subprocess
import sys

import pytest

from echelon.bridge.can.link_kind import is_hardware, link_kind
from support.runs import ROOT

NAMESPACE = ("unshare", "--user", "--map-root-user", "--net")
"""Runs a program where it may make network interfaces"""


def in_namespace(*command: str) -> subprocess.CompletedProcess[str]:
    made = "ip link add can7 type veth peer name can8 && ip link set can7 up && ip link set lo up && "
    script = made + 'exec "$@"'
    return subprocess.run(
        [*NAMESPACE, "sh", "-c", script, "sh", *command],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )


needs_namespace = pytest.mark.skipif(
    shutil.which("ip") is None or in_namespace("true").returncode != 0,
    reason="no network namespace with a veth interface",
)


def test_a_bus_that_is_no_interface_is_no_hardware() -> None:
    assert not is_hardware("virtual:can0")
    assert not is_hardware("udp_multicast:239.74.163.2:43113")
    assert link_kind("lo") is None
    assert link_kind("nowhere0") is None
    assert is_hardware("socketcan:nowhere0")  # what cannot be asked counts as hardware


@needs_namespace
def test_the_kernel_says_the_kind() -> None:
    program = "from echelon.bridge.can.link_kind import link_kind; print(link_kind('can7'))"
    assert in_namespace(sys.executable, "-c", program).stdout == "veth\n"


@pytest.mark.slow
@needs_namespace
@pytest.mark.parametrize("how", [(), ("--clock", "wall"), ("--engine", "inprocess")])
def test_torques_that_nobody_answers_do_not_go_to_hardware(how: tuple[str, ...], tmp_path: object) -> None:
    run = (sys.executable, "-m", "echelon", "run", "lab", "--can", "socketcan:can7", "--out", str(tmp_path), *how)
    refused = in_namespace(*run)
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1), refused.stderr
    assert "--real-bus" in refused.stderr
    asked = in_namespace(*run, "--real-bus", "--quiet", "--set", "duration=0.1")
    assert "is hardware" not in asked.stderr
