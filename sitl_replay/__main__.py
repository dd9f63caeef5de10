"""Entry point of the console command ``sitl-replay``, and of ``python -m sitl_replay``."""

from companion.cli.interrupts import (
    interrupts_end,
    name_process,
    open_missing_streams,
    threads_abandoned,
)


def main() -> None:
    """Load and run the command; Ctrl-C ends it with one line, even during loading."""
    open_missing_streams()
    with interrupts_end("sitl-replay"):
        name_process("sitl-replay")
        from sitl_replay.cli import main as command

        with threads_abandoned():
            command(prog_name="sitl-replay")


if __name__ == "__main__":
    main()
