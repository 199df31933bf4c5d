"""The processors that are emulated, and the compilers that build for them."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Target:
    """A processor.

    Attributes
    ----------
    zig_cpu, gcc_cpu : str
        Its name in the compilers' ``-mcpu``.
    clock_mhz : float
        A clock that is usual for it.
    divides : bool
        Whether it has UDIV; without it, `divide.c` is linked.
    """

    zig_cpu: str
    gcc_cpu: str
    clock_mhz: float
    divides: bool = True


TARGETS = {
    "cortex-m0plus": Target("cortex_m0plus", "cortex-m0plus", 48.0, divides=False),
    "cortex-m3": Target("cortex_m3", "cortex-m3", 72.0),
    "cortex-m4": Target("cortex_m4", "cortex-m4", 168.0),
}
COMPILERS = ("zig", "gcc")
