"""Entry point of the console command ``companion``, and of ``python -m companion``."""

from companion.cli.interrupts import (
    interrupts_end,
    name_process,
    open_missing_streams,
    threads_abandoned,
)


def main() -> None:
    """Load and run the command; Ctrl-C ends it with one line, even while it loads."""
    open_missing_streams()
    with interrupts_end("companion"):
        name_process("companion")
        from companion.cli.main import main as command

        with threads_abandoned():
            command(prog_name="companion")


if __name__ == "__main__":
    main()
