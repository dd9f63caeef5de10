"""Searches for bytes at which a target fails, guided by what code they reach.

    make fuzz                                every target, FUZZ_SECONDS (600) each
    python tests/fuzzing/run.py fold 60      one of them for a minute

It begins with the corpus beside this file and keeps what reaches new code in ``build/fuzz/TARGET``;
bytes at which it fails are left there as ``crash-…`` and are its exit status. With ``--keep`` some
of what was found goes into the corpus.
"""

import shutil
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
CORPUS = HERE / "corpus"
LONGEST = 4096
"""Bytes of a try."""
SLOWEST_S = 30
"""A try that takes longer hangs, and is a failure."""
KEPT = 40
"""Files of a search that go into the corpus."""
AFTER_S = 600
"""What a search may take beyond its time."""
MEMORY_MB = 1500
"""What a process may take, the instrumentation and sanitizer's own included."""


def main() -> int:
    """Fuzz one target for some seconds."""
    name, seconds, *options = sys.argv[1:]
    work = ROOT / "build" / "fuzz" / name
    work.mkdir(parents=True, exist_ok=True)
    (CORPUS / name).mkdir(parents=True, exist_ok=True)
    command = [sys.executable, str(HERE / "run.py"), "--child", name, str(work), str(CORPUS / name)]
    limits = [f"-max_len={LONGEST}", f"-timeout={SLOWEST_S}", f"-rss_limit_mb={MEMORY_MB}"]
    search = [*command, *limits, f"-max_total_time={seconds}", f"-artifact_prefix={work}/"]
    ended = subprocess.run(search, check=False, timeout=int(seconds) + AFTER_S).returncode
    if ended == 0 and "--keep" in options:
        keep(work, CORPUS / name)
    return ended


def keep(found: Path, corpus: Path) -> None:
    """Copy some of the found inputs, of all lengths: each reached new code when found."""
    files = sorted(
        (one for one in found.iterdir() if one.is_file()), key=lambda x: x.stat().st_size
    )
    for file in files[:: max(1, len(files) // KEPT)]:
        shutil.copy(file, corpus)


def child() -> None:
    """The process with instrumented code."""
    import atheris

    sys.path[:0] = [str(HERE), str(HERE.parent), str(ROOT)]
    with atheris.instrument_imports(include=["companion", "tomllib"]):
        from targets import TARGETS
    atheris.Setup([sys.argv[0], *sys.argv[3:]], TARGETS[sys.argv[2]])
    atheris.Fuzz()


if __name__ == "__main__":
    if sys.argv[1] == "--child":
        child()
    else:
        sys.exit(main())
