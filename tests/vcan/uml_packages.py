"""The Debian packages a guest is made of, unpacked into a private directory; nothing is installed."""

import fcntl
import os
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PACKAGES = ("user-mode-linux", "can-utils")
MODULES = (
    "net/can/can",
    "net/can/can-raw",
    "net/can/can-bcm",
    "drivers/net/can/dev/can-dev",
    "drivers/net/can/vcan",
)
"""Kernel modules for SocketCAN and vcan, in the order they must be loaded."""


class GuestError(Exception):
    """The guest could not be obtained or started, or it ended without the command's exit status."""


def unpacked(cache: Path) -> Path:
    """Return the directory the packages are unpacked in; download them when it is not there yet."""
    root = cache / "root"
    cache.mkdir(parents=True, exist_ok=True)
    with _locked(cache):  # of two first runs at once, one downloads
        if not root.is_dir():
            with tempfile.TemporaryDirectory(dir=cache, prefix="download-") as staging:
                _download(Path(staging))
                for archive in Path(staging).glob("*.deb"):
                    _run("dpkg", "-x", str(archive), f"{staging}/root")
                os.rename(f"{staging}/root", root)
    return root


def kernel_modules(root: Path) -> list[Path]:
    """Return the files of `MODULES`."""
    found = []
    for name in MODULES:
        files = list(root.glob(f"usr/lib/uml/modules/*/kernel/{name}.ko"))
        if len(files) != 1:
            raise GuestError(f"{root}: one kernel module {name}.ko expected, {len(files)} found")
        found += files
    return found


@contextmanager
def _locked(directory: Path) -> Iterator[None]:
    """Exclude all other processes that lock the same directory."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _download(directory: Path) -> None:
    """Download into `directory`; refresh the package lists only if the first attempt fails."""
    download = ("apt-get", "-q", "-o", "APT::Sandbox::User=root", "download", *PACKAGES)
    try:
        _run(*download, cwd=directory)
    except GuestError:
        try:
            _run("apt-get", "-q", "update")
            _run(*download, cwd=directory)
        except GuestError as error:
            raise GuestError(
                f"no packages {' and '.join(PACKAGES)} ({error}): on Debian or Ubuntu, amd64, run "
                "`apt-get update` as root with network access, then try again"
            ) from None


def _run(*command: str, cwd: Path | None = None) -> None:
    try:
        done = subprocess.run(command, cwd=cwd, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    except OSError as error:
        raise GuestError(f"{command[0]}: {error.strerror}") from None
    if done.returncode:
        reason = (done.stderr.strip() or done.stdout.strip() or f"status {done.returncode}").splitlines()[-1]
        raise GuestError(f"{command[0]}: {reason}")
