"""Entry point of the console command ``companion``, and of ``python -m companion``."""

import os
import signal


def main() -> None:
    """Load the command and run it; Ctrl-C ends it with one line, even while it is still loading.

    An exception raised by the signal would surface in the middle of some package's import, and come
    out as whatever that package makes of it. While nothing is open yet, the process simply ends.
    """
    signal.signal(signal.SIGINT, _end)
    from companion.cli.main import main as command

    signal.signal(signal.SIGINT, signal.default_int_handler)
    command(prog_name="companion")


def _end(_number: int, _frame: object) -> None:
    os.write(2, b"companion: interrupted\n")
    os._exit(130)


if __name__ == "__main__":
    main()
