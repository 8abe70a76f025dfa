"""The CAN checks of `echelon doctor`: buses, interfaces, and tools."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Final

from echelon.bridge.can.bus import open_bus
from echelon.bridge.can.bus_url import interface_is_up, resolve_url
from echelon.plan.plan import Plan
from echelon.shipped import FOLDER
from echelon.sim.bus_urls import ADVICE
from echelon.sim.doctor.diagnosis import LIMIT_S, Diagnosis

SHORT_QUEUE: Final = 100
"""A burst soon fills the send queue of an interface that is shorter than this [frames]"""
NET: Final = Path("/sys/class/net")
_CAN_TYPE: Final = "280"  # ARPHRD_CAN of linux/if_arp.h
_TOOLS: Final = f"{Path(sys.executable).parent}:{os.environ.get('PATH', '')}:/usr/local/sbin:/usr/sbin:/sbin"


def check_vcan(name: str = "vcan0") -> Diagnosis:
    """Checks for the virtual interface that runs use first; the advice is how to get it."""
    if interface_is_up(name):
        return Diagnosis(name, "ok", "is up: frames of runs go there, `candump vcan0` shows them")
    if (NET / name).exists():
        return Diagnosis(name, "note", "is there, but down", (f"sudo ip link set {name} up",))
    if vcan_module():
        more = "sudo modprobe vcan; " if not Path("/sys/module/vcan").exists() else ""
        made = f"sudo ip link add {name} type vcan; sudo ip link set {name} up txqueuelen 1000"
        return Diagnosis(name, "note", "does not exist, but the kernel can make it", (more + made,))
    guest = (
        f"bash {FOLDER.parent / 'vcan.sh'} COMMAND, which runs the command in a small virtual machine that has vcan0"
    )
    if not shutil.which("linux.uml", path=_TOOLS):
        guest += " (apt-get install user-mode-linux busybox-static iproute2)"
    return Diagnosis(
        name, "note", "does not exist, and this kernel has no module vcan", ("use udp_multicast, or", guest)
    )


def vcan_module() -> bool:
    """Returns whether the kernel has vcan or can load it."""
    if Path("/sys/module/vcan").exists():
        return True
    return _output("modprobe", "--dry-run", "--quiet", "vcan") is not None


def _output(program: str, *arguments: str) -> str | None:
    """Returns the output of a command; None if it is missing or fails."""
    try:
        command = [shutil.which(program, path=_TOOLS) or program, *arguments]
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S / 2, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None


def check_multicast() -> Diagnosis:
    """Checks that a frame gets through over multicast, which runs use without vcan0."""
    url = resolve_url("udp_multicast:") if interface_is_up("vcan0") else resolve_url("auto")
    advice = (ADVICE,)
    try:
        with open_bus(url) as sender, open_bus(url) as receiver:
            begun_s = time.perf_counter()
            sent = sender.send(0x123, b"doctor")
            frame = receiver.recv(LIMIT_S / 2) if sent else None
            took_us = (time.perf_counter() - begun_s) * 1e6
            error = sender.error or receiver.error or "it did not arrive"
    except OSError as cannot:
        return Diagnosis("multicast", "note", str(cannot), advice)
    if frame is None or (frame.can_id, frame.data) != (0x123, b"doctor"):
        return Diagnosis("multicast", "note", f"a frame on {url}: {error}", advice)
    return Diagnosis("multicast", "ok", f"a frame on {url} arrived after {took_us:.0f} µs")


def check_interfaces(net: Path = NET) -> list[Diagnosis]:
    """Checks bit rate, state and queue of all CAN interfaces except vcan0."""
    results = []
    for path in sorted(net.glob("*")):
        try:
            is_can = (path / "type").read_text().strip() == _CAN_TYPE
            queue = int((path / "tx_queue_len").read_text()) if is_can else 0
        except (OSError, ValueError):
            continue
        if is_can:
            results.append(_interface(path.name, queue, _link(path.name)))
    return results


def _link(name: str) -> dict[str, Any]:
    """Returns the details of an interface from `ip`; empty if it is missing or the output is not understood."""
    try:
        rows = json.loads(_output("ip", "-details", "-json", "link", "show", "dev", name) or "[]")
        return dict(rows[0]) if rows else {}
    except (ValueError, TypeError, KeyError):
        return {}


def _interface(name: str, queue: int, link: dict[str, Any]) -> Diagnosis:
    info = link.get("linkinfo", {})
    data = info.get("info_data", {})
    parts, advice = [str(info.get("info_kind", "CAN"))], []
    if bitrate := data.get("bittiming", {}).get("bitrate"):
        parts.append(f"{bitrate / 1e3:g} kbit/s")
    if state := data.get("state"):
        parts.append(str(state).lower())
    up = "UP" in link.get("flags", ()) if link else interface_is_up(name)
    if not up:
        parts.append("down")
        speed = "" if name.startswith("vcan") or bitrate else " type can bitrate 500000"
        advice.append(f"sudo ip link set {name} up{speed}")
    elif state in ("BUS-OFF", "STOPPED"):
        advice.append(f"sudo ip link set {name} type can restart-ms 100; check wiring, termination and bit rate")
    elif state in ("ERROR-PASSIVE", "ERROR-WARNING"):
        advice.append("frames are disturbed or not acknowledged: check wiring, termination and bit rate")
    parts.append(f"queue of {queue} frames")
    if queue < SHORT_QUEUE and not name.startswith("vcan"):  # the queue of a vcan is never full
        advice.append(f"a burst fills it: sudo ip link set {name} txqueuelen 1000")
    return Diagnosis(name, "note" if advice else "ok", ", ".join(parts), tuple(advice))


def check_tools() -> Diagnosis:
    """Checks for tools that show a bus; no run needs them."""
    packages = {"candump": "can-utils", "cansend": "can-utils", "ip": "iproute2", "cantools": "python3-cantools"}
    found = [name for name in packages if shutil.which(name, path=_TOOLS)]
    if len(found) < len(packages):
        wanted = " ".join(sorted({package for name, package in packages.items() if name not in found}))
        return Diagnosis(
            "CAN tools", "note", f"found: {', '.join(found) or 'none'}", (f"sudo apt-get install {wanted}",)
        )
    return Diagnosis("CAN tools", "ok", ", ".join(found))


def check_fit(plan: Plan) -> list[Diagnosis]:
    """Checks whether the frames of a plan fit its buses."""
    from echelon.bridge.timing.fit import plan_fit

    results = []
    for fit in plan_fit(plan):
        first, *rest = fit.lines
        results.append(Diagnosis(f"bus {fit.bus}", "ok" if fit.fits else "problem", first, tuple(map(str.strip, rest))))
    return results
