"""``hil`` and ``python -m hil``."""

import os
import signal
import sys


def main() -> int:
    """Run the command line; an interrupt while it is being loaded ends it quietly."""
    try:
        import hil.bus.mf4_on_demand  # noqa: F401  before python-can is imported
        from hil.cli import main as run  # compiles the plant and the kernel when they have changed

        code = run()
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        print("hil: interrupted", file=sys.stderr)
        return 128 + signal.SIGINT
    except BrokenPipeError:  # whoever reads has enough, as `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE


if __name__ == "__main__":
    sys.exit(main())
