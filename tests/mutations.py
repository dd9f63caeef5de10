"""Small faults put into a copy of the code, one at a time: some test has to notice each.

    python tests/mutations.py          all of them; or by number: 3 14 20-25

Run by hand, with the project's Python; pytest does not collect it. ``mutations.toml`` has the
faults. The tree itself is not touched. Status 1 where a fault is not noticed.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
LEFT_BEHIND = shutil.ignore_patterns(".*", "__pycache__", "build", "dist", "node_modules")
PYTEST = ("-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "--timeout", "300")
QUICK = ("-m", "not full and not benchmark and not soak")


class Mutation(NamedTuple):
    """``old`` occurs once in ``file`` and becomes ``new``; one of ``tests`` has to fail then."""

    what: str
    file: str
    old: str
    new: str
    tests: list[str]


def read_table() -> list[Mutation]:
    """All faults, in the order of their numbers, which begin at 1."""
    text = (ROOT / "tests" / "mutations.toml").read_text()
    return [Mutation(**found) for found in tomllib.loads(text)["mutation"]]


def chosen(words: list[str], count: int) -> list[int]:
    """The numbers that are asked for: ``7``, ``7-9``; all where none is."""
    numbers: list[int] = []
    for word in words:
        first, _, last = word.partition("-")
        numbers += range(int(first), int(last or first) + 1)
    return numbers or list(range(1, count + 1))


def run(tests: Iterable[str], tree: Path) -> "subprocess.CompletedProcess[str]":
    """Tests of a copy, up to the first that fails. Nothing compiled is kept: of one second and
    one size, it would hide a change."""
    environment = os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, *PYTEST, *QUICK, *tests]
    return subprocess.run(
        command, cwd=tree, env=environment, capture_output=True, text=True, check=False
    )


def outcome(mutation: Mutation, tree: Path) -> tuple[str, bool]:
    """What became of a fault in a copy of the tree, and whether a test noticed it."""
    path = tree / mutation.file
    sound = path.read_text()
    if sound.count(mutation.old) != 1:
        return (
            f"out of date: its text is in {mutation.file} {sound.count(mutation.old)} times",
            False,
        )
    path.write_text(sound.replace(mutation.old, mutation.new))
    try:
        done = run(mutation.tests, tree)
    finally:
        path.write_text(sound)
    failed = re.findall(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    if failed:
        return f"noticed by {failed[0]}", True
    last = (done.stdout + done.stderr).strip().splitlines()[-1]
    return f"{'NOT TESTED' if done.returncode else 'SURVIVED'}: {last}", False


def main() -> int:
    """Try those that are asked for; first, that their tests pass without any fault."""
    table, missed = read_table(), 0
    numbers = chosen(sys.argv[1:], len(table))
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        shutil.copytree(ROOT, tree, ignore=LEFT_BEHIND)
        sound = run(sorted({test for n in numbers for test in table[n - 1].tests}), tree)
        if sound.returncode:
            print(sound.stdout, sound.stderr, "without any fault the tests fail", sep="\n")
            return 1
        for number in numbers:
            found, noticed = outcome(table[number - 1], tree)
            missed += not noticed
            print(f"{number:3} {table[number - 1].what}: {found}", flush=True)
    return missed > 0


if __name__ == "__main__":
    sys.exit(main())
