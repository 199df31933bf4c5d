"""Process 1 of the guest: make a `vcan0`, run the job, leave its exit status, power off.

The guest's kernel starts it as ``guest_init.py RUN_DIR``, where `guest.py` leaves ``job.json`` and looks for
``status`` afterwards. It uses system calls only, so that neither iproute2 nor kmod is needed.
"""

import ctypes
import fcntl
import json
import os
import socket
import struct
import subprocess
import sys
import termios
import traceback
from pathlib import Path

STATUS_CANNOT_RUN = 127
RMEM_DEFAULT_BYTES = 32 << 20  # a CAN socket with the kernel's default loses frames of a burst

RB_POWER_OFF = 0x4321FEDC
SIOCGIFFLAGS, SIOCSIFFLAGS, IFF_UP = 0x8913, 0x8914, 1
RTM_NEWLINK, RTM_DELLINK = 16, 17
NLM_F_REQUEST, NLM_F_ACK, NLM_F_CREATE, NLM_F_EXCL = 1, 4, 0x400, 0x200
SIZEOF_IFINFOMSG, IFLA_IFNAME, IFLA_LINKINFO, IFLA_INFO_KIND = 16, 3, 18, 1

LIBC = ctypes.CDLL(None, use_errno=True)


def main(run_dir: Path) -> None:
    try:
        mount_private_file_systems()
        use_terminal("/dev/tty1")
        job = json.loads((run_dir / "job.json").read_text())
        Path("/proc/sys/net/core/rmem_default").write_text(str(RMEM_DEFAULT_BYTES))
        for path in job["modules"]:
            load_module(Path(path))
        create_link("vcan0", "vcan")
        for name in ("lo", "vcan0"):
            set_link(name, up=True)
        status = run(job["command"], job["cwd"], job["env"])
        (run_dir / "status").write_text(str(status))
    except Exception:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        termios.tcdrain(1)  # what the terminal still holds is lost at power-off
        os.sync()
        LIBC.reboot(RB_POWER_OFF)


def mount_private_file_systems() -> None:
    """Mount what must be the guest's own; the kernel has mounted ``/dev``, all the rest is the host's."""
    os.makedirs("/dev/pts", exist_ok=True)
    os.makedirs("/dev/shm", exist_ok=True)
    for kind, target in (
        ("proc", "/proc"),
        ("sysfs", "/sys"),
        ("devpts", "/dev/pts"),
        ("tmpfs", "/dev/shm"),
        ("tmpfs", "/run"),
    ):
        check(LIBC.mount(kind.encode(), target.encode(), kind.encode(), 0, None), f"mount {target}")
    for link, target in (("fd", "fd"), ("stdin", "fd/0"), ("stdout", "fd/1"), ("stderr", "fd/2")):
        os.symlink(f"/proc/self/{target}", f"/dev/{link}")


def use_terminal(path: str) -> None:
    """Make the terminal this process's output, without turning line feeds into CR LF."""
    terminal = os.open(path, os.O_RDWR | os.O_NOCTTY)
    attributes = termios.tcgetattr(terminal)
    attributes[1] &= ~termios.OPOST
    termios.tcsetattr(terminal, termios.TCSANOW, attributes)
    os.dup2(terminal, 1)
    os.dup2(terminal, 2)


def load_module(path: Path) -> None:
    """Load one kernel module."""
    image = path.read_bytes()
    check(LIBC.init_module(image, ctypes.c_ulong(len(image)), b""), f"load {path.name}")


def create_link(name: str, kind: str) -> None:
    """Create a network device, as ``ip link add dev NAME type KIND`` does."""
    device_kind = attribute(IFLA_LINKINFO, attribute(IFLA_INFO_KIND, kind.encode()))
    device_name = attribute(IFLA_IFNAME, name.encode() + b"\0")
    request_link(name, RTM_NEWLINK, NLM_F_CREATE | NLM_F_EXCL, device_name + device_kind)


def delete_link(name: str) -> None:
    """Remove a network device, as ``ip link delete NAME`` does."""
    request_link(name, RTM_DELLINK, 0, attribute(IFLA_IFNAME, name.encode() + b"\0"))


def request_link(name: str, kind: int, flags: int, attributes: bytes) -> None:
    """Ask the kernel for a change of its network devices."""
    body = bytes(SIZEOF_IFINFOMSG) + attributes
    header = struct.pack("IHHII", 16 + len(body), kind, NLM_F_REQUEST | NLM_F_ACK | flags, 1, 0)
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as netlink:
        netlink.send(header + body)
        error = -struct.unpack_from("i", netlink.recv(4096), 16)[0]
    if error:
        raise OSError(error, os.strerror(error), name)


def attribute(kind: int, payload: bytes) -> bytes:
    """Encode one netlink attribute, padded to 4 bytes."""
    return struct.pack("HH", 4 + len(payload), kind) + payload + bytes(-len(payload) % 4)


def set_link(name: str, *, up: bool) -> None:
    """Set a network device up or down, as ``ip link set up NAME`` does."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        request = struct.pack("16sH14x", name.encode(), 0)
        flags = struct.unpack_from("H", fcntl.ioctl(control, SIOCGIFFLAGS, request), 16)[0]
        flags = flags | IFF_UP if up else flags & ~IFF_UP
        fcntl.ioctl(control, SIOCSIFFLAGS, struct.pack("16sH14x", name.encode(), flags))


def run(command: list[str], cwd: str, env: dict[str, str]) -> int:
    """Run the job and return its status, as a shell would number it."""
    if runtime_dir := env.get("XDG_RUNTIME_DIR"):
        os.makedirs(runtime_dir, mode=0o700, exist_ok=True)  # /run is empty here
    try:
        job = subprocess.Popen(command, cwd=cwd, env=env, stdin=subprocess.DEVNULL)
    except OSError as error:
        print(f"guest: cannot run {command[0]} in {cwd}: {error.strerror}", file=sys.stderr)
        return STATUS_CANNOT_RUN
    while True:
        pid, wait_status = os.wait()  # also reaps orphans, as process 1 must
        if pid == job.pid:
            code = os.waitstatus_to_exitcode(wait_status)
            return code if code >= 0 else 128 - code


def check(result: int, what: str) -> None:
    if result:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), what)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
