"""``hil`` and ``python -m hil``."""

import signal
import sys


def main() -> int:
    """Run the command line; an interrupt while it is being loaded ends it quietly."""
    try:
        import hil.bus.mf4_on_demand  # noqa: F401  before python-can is imported
        from hil.cli import main as run  # compiles the plant and the kernel when they have changed

        return run()
    except KeyboardInterrupt:
        print("hil: interrupted", file=sys.stderr)
        return 128 + signal.SIGINT


if __name__ == "__main__":
    sys.exit(main())
