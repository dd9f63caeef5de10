"""Rules of the code base as tests: contents of each package, and files that must not be committed.

Each rule is a function from source text to a list of faults. It runs over the tree and, below,
over small pieces of bad code that it must reject: a rule that finds nothing there is broken.
Imports between packages are import-linter's task (``pyproject.toml``); it runs here as well.
"""

import ast
import functools
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import pytest
from collected_texts import broken_rules
from support import HANG_S

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("companion", "sitl_replay")
LOCKS = ("requirements.lock", "requirements-dev.lock")
LONGEST_MODULE_LINES = 300
REASON = "Over 300 lines: "
FIELDS_TO_NAME = 4
"""Number of fields from which each must be passed by name."""
MOST_POSITIONAL = 5
TAKE_ANY_NUMBER = frozenset({"max", "min", "pack", "pack_into", "zip"})

# Packages that may use sockets, files, clocks and `await`; all others are pure.
SHELL = (
    "companion/__main__.py",
    "companion/client.py",
    "companion/mavlink/links/",
    "companion/recording/",
    "companion/node/",
    "companion/server/",
    "companion/studies/running/",
    "companion/cli/",
    "sitl_replay/cli.py",
    "sitl_replay/traffic/",
)
READS_FILES = ("companion/settings/", "companion/beams/weights/shapes.py")

# Modules by which clocks, sockets, files, threads and processes are reached.
# fmt: off
IMPURE_MODULES = frozenset({
    "anyio", "asyncio", "concurrent", "glob", "multiprocessing", "os", "select", "selectors",
    "serial", "shutil", "signal", "socket", "socketserver", "ssl", "subprocess",
    "tempfile", "threading", "time",
})
# fmt: on
# A path is a value, and `io` holds bytes in memory: only a call that reaches a file counts.
FILE_CALLS = frozenset(
    {
        "exists",
        "is_dir",
        "is_file",
        "iterdir",
        "mkdir",
        "open",
        "read_bytes",
        "read_text",
        "rename",
        "rglob",
        "stat",
        "unlink",
        "write_bytes",
        "write_text",
    }
)
CLOCK_CALLS = frozenset({"now", "today", "utcnow"})
# Words that refer to something before; no docstring may begin with one.
RIDDLE = re.compile(
    r"\s*(Of|So|And|But|Or|Nor|Also|Then|Thus|Hence|For\s+(?:so|that|which))\b", re.IGNORECASE
)

# Words that no textbook, RFC or MAVLink documentation uses.
OBSCURE = frozenset(
    {"anew", "aside", "ears", "lent", "nobody", "said", "seated", "spared", "sure", "told", "twins",
     "unsure", "untold", "vouch"}
)  # fmt: skip
OBSCURE_KEPT = {
    "said": "modules of frames and of rows, named in docs/architecture.md",
    "_said": "a row's own getter",
    "_Said": "a payload with its time",
}
REPEATED_CLASSES = {
    "Weights": "the client's class holds the answer that the view's class describes"
}

# In parts, so that this file does not contain the searched text.
# fmt: off
REGISTRY_HOSTS = tuple(".".join(parts) for parts in (
    ("pypi", "org"), ("pythonhosted", "org"), ("anaconda", "org"), ("npmjs", "org"),
    ("npmjs", "com"), ("yarnpkg", "com"), ("unpkg", "com"), ("jsdelivr", "net"), ("jsr", "io"),
    ("crates", "io"), ("rubygems", "org"), ("proxy", "golang", "org"), ("maven", "org"),
    ("docker", "io"), ("ghcr", "io"), ("quay", "io"), ("gcr", "io"),
))
# fmt: on


def sources() -> list[str]:
    """Return every module of both packages, as a path from the root."""
    found = (p for package in PACKAGES for p in (ROOT / package).rglob("*.py"))
    return sorted(p.relative_to(ROOT).as_posix() for p in found)


def committed() -> list[str]:
    """Return every file that is or would be committed; without git, every file not made by a
    tool.
    """
    git = ("git", "ls-files", "-z", "--cached", "--others", "--exclude-standard")
    if shutil.which("git") and (ROOT / ".git").exists():
        done = subprocess.run(git, cwd=ROOT, capture_output=True, check=True, timeout=HANG_S)
        names = done.stdout.decode().split("\0")
        return sorted(name for name in names if name and (ROOT / name).is_file())
    made = re.compile(r"(^|/)(\.git|\.venv|\.\w+_cache|\.hypothesis|__pycache__|build|dist)/")
    found = (p.relative_to(ROOT).as_posix() for p in ROOT.rglob("*") if p.is_file())
    return sorted(name for name in found if not made.search(name))


def is_pure(path: str) -> bool:
    """Return whether the module at ``path`` may use no clock, socket, file or await."""
    return not path.startswith(SHELL)


@functools.cache
def parsed(text: str) -> ast.Module:
    """Return a module's tree, cached for several rules."""
    return ast.parse(text)


@functools.cache
def nodes_of(text: str) -> list[ast.AST]:
    """Return all nodes of a module's tree, cached for several rules."""
    return list(ast.walk(parsed(text)))


def imports(text: str) -> Iterator[tuple[int, str]]:
    """Return line and full dotted name of every import; ``from a import b`` gives ``a.b``."""
    for node in nodes_of(text):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, name.name) for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            yield from ((node.lineno, f"{module}.{name.name}") for name in node.names)


# --- rules: path and source text to faults ------------------------------------------------------


def impurities(path: str, text: str) -> list[str]:
    """Await, clocks, sockets and files in a pure package."""
    if not is_pure(path):
        return []
    may_read = path.startswith(READS_FILES)
    faults = [
        f"{path}:{line}: imports {name}"
        for line, name in imports(text)
        if name.split(".")[0] in IMPURE_MODULES
    ]
    for node in nodes_of(text):
        match node:
            case ast.AsyncFunctionDef() | ast.Await() | ast.AsyncFor() | ast.AsyncWith():
                faults.append(f"{path}:{node.lineno}: is asynchronous")
            case ast.comprehension(is_async=1):
                faults.append(f"{path}:{node.iter.lineno}: is asynchronous")
            case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name)):
                if name in CLOCK_CALLS:
                    faults.append(f"{path}:{node.lineno}: reads a clock: {name}()")
                if name in FILE_CALLS and not may_read:
                    faults.append(f"{path}:{node.lineno}: touches a file: {name}()")
    return faults


def heavy_imports(path: str, text: str) -> list[str]:
    """CVXPY outside the LMI; pymavlink's mavutil anywhere."""
    faults = []
    for line, name in imports(text):
        if name.startswith("cvxpy") and path != "companion/tracking/design/lmi.py":
            faults.append(f"{path}:{line}: imports cvxpy")
        if "mavutil" in name.split("."):
            faults.append(f"{path}:{line}: imports mavutil")
    return faults


def foreign_imports(path: str, text: str) -> list[str]:
    """``values`` imports only the standard library, numpy and itself."""
    if not path.startswith("companion/values/"):
        return []
    allowed = sys.stdlib_module_names | {"numpy"}
    return [
        f"{path}:{line}: imports {name}"
        for line, name in imports(text)
        if name.split(".")[0] not in allowed and not name.startswith("companion.values.")
    ]


def strangers(path: str, text: str) -> list[str]:
    """``sitl_replay`` imports only values, wire, geodesy, reader, console, signals, client, and
    the records that the client does not write.
    """
    if not path.startswith("sitl_replay/"):
        return []
    allowed = re.compile(
        r"companion\.(values|mavlink|tracking\.geodesy|recording\.reader|views\.observation_records|client|node\.signals|cli\.(console|interrupts)|__version__)(\.|$)"
    )
    return [
        f"{path}:{line}: imports {name}"
        for line, name in imports(text)
        if name.split(".")[0] == "companion" and not allowed.match(name)
    ]


def undocumented(path: str, text: str) -> list[str]:
    """Modules, public classes, functions and methods without a docstring.

    Properties are attributes, described in the docstring of their class. Methods of a class with
    a base may be documented in the base.
    """
    tree = parsed(text)
    faults = [] if ast.get_docstring(tree) or not tree.body else [f"{path}:1: no docstring"]

    def visit(body: list[ast.stmt], prefix: str) -> None:
        for node in body:
            if not isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            marks = {ast.unparse(mark).split(".")[-1] for mark in node.decorator_list}
            if node.name.startswith("_") or marks & {"property", "setter", "overload"}:
                continue
            if not ast.get_docstring(node):
                faults.append(f"{path}:{node.lineno}: {prefix}{node.name} has no docstring")
            if isinstance(node, ast.ClassDef) and not node.bases:
                visit(node.body, f"{prefix}{node.name}.")

    visit(tree.body, "")
    return faults


def documentation(text: str) -> Iterator[tuple[int, str]]:
    """Return line and text of every docstring, and of every string after an assignment."""
    documented = (
        ast.Module,
        ast.ClassDef,
        ast.FunctionDef,
        ast.AsyncFunctionDef,
        ast.Assign,
        ast.AnnAssign,
    )
    for node in nodes_of(text):
        body = getattr(node, "body", None)
        if not isinstance(body, list):  # the body of a lambda is an expression
            continue
        for before, statement in zip([node, *body], body, strict=False):
            match statement:
                case ast.Expr(value=ast.Constant(value=str(said))):
                    if isinstance(before, documented):
                        yield statement.lineno, said


def riddles(path: str, text: str) -> list[str]:
    """Docstrings that start mid-sentence: the first words must say what the thing is or does."""
    faults = []
    for line, said in documentation(text):
        found = RIDDLE.match(said)
        if found:
            faults.append(f"{path}:{line}: a docstring begins with {found[1]!r}")
    return faults


def overlong(path: str, text: str) -> list[str]:
    """Modules that are too long and do not give a reason."""
    lines = text.count("\n")
    if lines <= LONGEST_MODULE_LINES:
        return []
    said = ast.get_docstring(parsed(text)) or ""
    return [] if REASON in said else [f"{path}: {lines} lines, and its docstring has no reason"]


def nameless(path: str, _text: str) -> list[str]:
    """Modules with meaningless names."""
    bad = Path(path).stem in {"utils", "util", "helpers", "helper", "common", "misc"}
    return [f"{path}: says nothing of what is in it"] if bad else []


def called(node: ast.AST) -> str:
    """Return the last part of the name of a class, a decorator or a called function."""
    if isinstance(node, ast.Call | ast.Subscript):
        node = node.func if isinstance(node, ast.Call) else node.value
    return ast.unparse(node).rpartition(".")[2]


def init_fields(node: ast.ClassDef) -> list[str]:
    """Return the fields of a dataclass or NamedTuple that its constructor takes."""
    found = []
    for item in node.body:
        match item:
            case ast.AnnAssign(target=ast.Name(id=name), annotation=kind, value=value):
                is_made = isinstance(value, ast.Call) and any(
                    given.arg == "init" and ast.unparse(given.value) == "False"
                    for given in value.keywords
                )
                if called(kind) == "KW_ONLY":
                    return found  # later fields are keyword-only
                if called(kind) != "ClassVar" and not is_made:
                    found.append(name)
    return found


def positional_fields(path: str, text: str) -> list[str]:
    """Classes with four or more positional values, two of which could be swapped."""
    faults = []
    for node in nodes_of(text):
        if not isinstance(node, ast.ClassDef):
            continue
        for mark in node.decorator_list:
            is_long = called(mark) == "dataclass" and len(init_fields(node)) >= FIELDS_TO_NAME
            if is_long and "kw_only=True" not in ast.unparse(mark):
                faults.append(f"{path}:{node.lineno}: {node.name} is not kw_only=True")
        for item in node.body:
            if isinstance(item, ast.FunctionDef) and item.name == "__init__":
                placed = [*item.args.posonlyargs, *item.args.args][1:]
                if placed and len(placed) + len(item.args.kwonlyargs) >= FIELDS_TO_NAME:
                    faults.append(f"{path}:{item.lineno}: {node.name}.__init__ has no * after self")
    return faults


@functools.cache
def long_tuples() -> frozenset[str]:
    """Full dotted names of the NamedTuples with four or more fields."""
    return frozenset(
        f"{module_of(path)}.{name}"
        for path in sources()
        for name in long_tuples_in((ROOT / path).read_text(encoding="utf-8"))
    )


def long_tuples_in(text: str) -> list[str]:
    """Names of the NamedTuples with four or more fields that a module defines."""
    return [
        node.name
        for node in nodes_of(text)
        if isinstance(node, ast.ClassDef)
        and "NamedTuple" in map(called, node.bases)
        and len(init_fields(node)) >= FIELDS_TO_NAME
    ]


def module_of(path: str) -> str:
    """The dotted name of the module at ``path``."""
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def positional_tuples(path: str, text: str) -> list[str]:
    """Calls that pass a field of a NamedTuple with four or more fields by position.

    Such a class cannot be keyword-only. It is found under the name by which it was imported,
    also from a package that re-exports it.
    """
    names = {name: f"{module_of(path)}.{name}" for name in long_tuples_in(text)}
    own = frozenset(names.values())
    for node in nodes_of(text):
        match node:
            case ast.ImportFrom(module=str(origin), names=imported):
                names |= {one.asname or one.name: f"{origin}.{one.name}" for one in imported}
            case ast.Import(names=imported):
                names |= {one.asname: one.name for one in imported if one.asname}
    faults = []
    for node in nodes_of(text):
        if isinstance(node, ast.Call) and node.args:
            head, _, rest = ast.unparse(node.func).partition(".")
            full = ".".join(filter(None, (names.get(head, head), rest)))
            package, _, name = full.rpartition(".")
            if any(
                one.endswith(f".{name}") and f"{one}.".startswith(f"{package}.")
                for one in long_tuples() | own
            ):
                faults.append(f"{path}:{node.lineno}: {name} is given fields by position")
    return faults


def crowded_calls(path: str, text: str) -> list[str]:
    """Calls with more than five positional arguments, except to variadic functions."""
    return [
        f"{path}:{node.lineno}: {called(node)} is given {len(node.args)} arguments by position"
        for node in nodes_of(text)
        if isinstance(node, ast.Call)
        and len(node.args) > MOST_POSITIONAL
        and called(node) not in TAKE_ANY_NUMBER
    ]


def defined_names(text: str) -> Iterator[tuple[int, str]]:
    """Line and name of every class and function, and of every constant of a module."""
    for node in nodes_of(text):
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield node.lineno, node.name
    for node in parsed(text).body:
        match node:
            case ast.AnnAssign(target=ast.Name(id=name)) | ast.Assign(targets=[ast.Name(id=name)]):
                yield node.lineno, name


def obscure_names(path: str, text: str) -> list[str]:
    """Names of modules, classes, functions and constants that a reader would have to look up."""
    if not path.startswith("companion/"):
        return []
    faults = []
    for line, name in ((1, Path(path).stem), *defined_names(text)):
        words = {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+", name)}
        faults += [
            f"{path}:{line}: {name} says {word!r}: use the field's word"
            for word in sorted(words & OBSCURE)
            if name not in OBSCURE_KEPT
        ]
    return faults


def repeated_classes(texts: Iterable[str]) -> list[str]:
    """Names that more than one class of these modules has."""
    counts = Counter(
        node.name for text in texts for node in nodes_of(text) if isinstance(node, ast.ClassDef)
    )
    return sorted(name for name, times in counts.items() if times > 1)


Rule = Callable[[str, str], list[str]]
RULES: tuple[Rule, ...] = (
    impurities,
    heavy_imports,
    foreign_imports,
    strangers,
    undocumented,
    riddles,
    overlong,
    nameless,
    positional_fields,
    positional_tuples,
    crowded_calls,
    obscure_names,
)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_source_tree_satisfies_the_rule(rule: Rule) -> None:
    paths = sources()
    assert "companion/values/received.py" in paths
    faults = [fault for p in paths for fault in rule(p, (ROOT / p).read_text(encoding="utf-8"))]
    assert not faults, "\n" + "\n".join(faults)


def test_tests_and_examples_pass_tuple_fields_by_name() -> None:
    paths = sorted(
        path for room in ("docs", "examples", "tests") for path in (ROOT / room).rglob("*.py")
    )
    assert ROOT / "tests/test_house.py" in paths
    faults = [
        fault
        for path in paths
        for fault in positional_tuples(
            path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")
        )
    ]
    assert not faults, "\n" + "\n".join(faults)


BEAMS = "companion/beams/array/steering.py"
VALUES = "companion/values/tracked.py"
FOUR = "\n    a: int\n    b: int\n    c: int\n    d: int"
BAD = [
    (impurities, BEAMS, "async def f(): ..."),
    (impurities, BEAMS, "async def f():\n    return [x async for x in g()]"),
    (impurities, BEAMS, "import time"),
    (impurities, BEAMS, "def f():\n    from time import monotonic_ns"),
    (impurities, BEAMS, "import asyncio.events as e"),
    (impurities, BEAMS, "import socket"),
    (impurities, BEAMS, "from os import path"),
    (impurities, BEAMS, "from pathlib import Path\nthere = Path('x').is_file()"),
    (impurities, BEAMS, "data = open('x')"),
    (impurities, BEAMS, "data = p.read_text()"),
    (impurities, VALUES, "from datetime import datetime\nt = datetime.now()"),
    (impurities, "companion/tracking/tracker.py", "t = time.time_ns(); import time"),
    (impurities, "companion/pipeline/fold.py", "import threading"),
    (impurities, "companion/mavlink/wire/framing.py", "import selectors"),
    (impurities, "companion/settings/model.py", "import os"),
    (heavy_imports, "companion/tracking/design/closed_form.py", "import cvxpy as cp"),
    (
        heavy_imports,
        "companion/studies/paper/experiments.py",
        "def f():\n    from cvxpy import Variable",
    ),
    (heavy_imports, "sitl_replay/traffic/player.py", "from pymavlink import mavutil"),
    (heavy_imports, "companion/mavlink/links/transport.py", "import pymavlink.mavutil"),
    (
        heavy_imports,
        "companion/node/service.py",
        "from pymavlink.mavutil import mavlink_connection",
    ),
    (foreign_imports, VALUES, "import scipy.linalg"),
    (foreign_imports, VALUES, "from companion.settings.model import Settings"),
    (foreign_imports, VALUES, "from .mavlink import framing"),
    (strangers, "sitl_replay/traffic/player.py", "from companion.pipeline.fold import step"),
    (strangers, "sitl_replay/traffic/player.py", "import companion.server.app"),
    (strangers, "sitl_replay/traffic/player.py", "from companion.recording import writer"),
    (strangers, "sitl_replay/traffic/player.py", "from companion import service"),
    (undocumented, BEAMS, "x = 1"),
    (undocumented, BEAMS, '"""."""\ndef f(): ...'),
    (undocumented, BEAMS, '"""."""\nasync def f(): ...'),
    (undocumented, BEAMS, '"""."""\nclass C:\n    x: int'),
    (undocumented, BEAMS, '"""."""\nclass C:\n    """."""\n    def f(self): ...'),
    (riddles, BEAMS, '"""Of each sender so many are kept."""'),
    (riddles, BEAMS, 'def f():\n    """So the bound holds."""'),
    (riddles, BEAMS, 'async def f():\n    """And what became of it."""'),
    (riddles, BEAMS, 'class C:\n    """But for the last."""'),
    (riddles, BEAMS, 'class C:\n    def f(self):\n        """Or None."""'),
    (riddles, BEAMS, 'KEPT: Final = 8\n"""Nor more than these."""'),
    (riddles, BEAMS, 'KEPT = 8\n"""Also of the second kind."""'),
    (riddles, BEAMS, 'class C:\n    x: int\n    """Then it is dropped."""'),
    (riddles, BEAMS, 'def f(self):\n    self.x = 1\n    """Thus counted."""'),
    (riddles, BEAMS, 'if x:\n    y = 1\n    """Hence the limit."""'),
    (riddles, BEAMS, 'WAIT_S = 5\n"""For so long after a request."""'),
    (riddles, BEAMS, 'WAIT_S = 5\n"""For which it is waited."""'),
    (riddles, BEAMS, 'WAIT_S = 5\n"""For\nthat it is kept."""'),
    (overlong, BEAMS, "x = 1\n" * (LONGEST_MODULE_LINES + 1)),
    (nameless, "companion/beams/utils.py", ""),
    (nameless, "sitl_replay/helpers.py", ""),
    (positional_fields, BEAMS, f"@dataclass\nclass C:{FOUR}"),
    (positional_fields, BEAMS, f"@dataclass(frozen=True, slots=True)\nclass C:{FOUR}"),
    (positional_fields, BEAMS, f"@dataclasses.dataclass(kw_only=False)\nclass C:{FOUR}"),
    (positional_fields, BEAMS, "class C:\n    def __init__(self, a, b, c, d): ..."),
    (positional_fields, BEAMS, "class C:\n    def __init__(self, a, *, b, c, d): ..."),
    (positional_tuples, BEAMS, f"class C(NamedTuple):{FOUR}\nC(1, b=2, c=3, d=4)"),
    (positional_tuples, BEAMS, f"class C(typing.NamedTuple):{FOUR}\nC(*row)"),
    (positional_tuples, BEAMS, "from companion.values.received import Frame\nFrame(1)"),
    (positional_tuples, BEAMS, "from companion.values import Frame as F\nF(1)"),
    (positional_tuples, BEAMS, "from companion.values import received\nreceived.Frame(1)"),
    (positional_tuples, BEAMS, "import companion.values\ncompanion.values.Frame(1)"),
    (positional_tuples, BEAMS, "import companion.values as v\nv.Frame(1)"),
    (crowded_calls, BEAMS, "f(1, 2, 3, 4, 5, 6)"),
    (crowded_calls, BEAMS, "f(1, 2, 3, 4, 5, *rest)"),
]


@pytest.mark.parametrize(("rule", "path", "text"), BAD)
def test_rule_rejects_bad_code(rule: Rule, path: str, text: str) -> None:
    assert rule(path, text)


GOOD = [
    (impurities, "companion/mavlink/links/transport.py", "import asyncio\nasync def f(): ..."),
    (impurities, "companion/recording/writer.py", "from pathlib import Path\nx = open('y')"),
    (
        impurities,
        "companion/settings/model.py",
        "from pathlib import Path\nx = Path('a').read_text()",
    ),
    (impurities, BEAMS, "from datetime import datetime\nimport numpy as np\ntime = 3\ntimeout = 4"),
    (heavy_imports, "companion/tracking/design/lmi.py", "def f():\n    import cvxpy"),
    (heavy_imports, "companion/mavlink/wire/decode.py", "from pymavlink.dialects.v20 import all"),
    (foreign_imports, VALUES, "from companion.values.numbers import FloatArray"),
    (foreign_imports, VALUES, "import enum\nfrom numpy.typing import NDArray"),
    (strangers, "sitl_replay/traffic/player.py", "from companion.values import Source"),
    (
        strangers,
        "sitl_replay/traffic/player.py",
        "from companion.mavlink.wire.framing import Splitter",
    ),
    (strangers, "sitl_replay/traffic/player.py", "from companion.recording.reader import frames"),
    (undocumented, BEAMS, '"""."""\ndef _f(): ...\nclass _C: ...'),
    (undocumented, BEAMS, ""),
    (riddles, BEAMS, '"""Recent rejections kept per sender."""'),
    (riddles, BEAMS, 'KEPT = 8\n"""For each sender, the rejections kept."""'),
    (riddles, BEAMS, 'KEPT = 8\n"""Often enough; offset of it, ordered, sorted, and so on."""'),
    (riddles, BEAMS, 'def f():\n    """``of`` the class."""\n    return "Of course"'),
    (riddles, BEAMS, 'x = "Of course"\nf(lambda: "So it is")'),
    (riddles, BEAMS, 'x = 1\n""""""'),
    (overlong, BEAMS, "x = 1\n" * LONGEST_MODULE_LINES),
    (overlong, BEAMS, f'"""A list.\n\n{REASON}it is one."""\n' + "x = 1\n" * LONGEST_MODULE_LINES),
    (positional_fields, BEAMS, f"@dataclass(slots=True, kw_only=True)\nclass C:{FOUR}"),
    (positional_fields, BEAMS, f"@dataclass\nclass C:{FOUR} = field(init=False)"),
    (positional_fields, BEAMS, f"@dataclass\nclass C:{FOUR.replace('d: int', 'd: ClassVar[int]')}"),
    (positional_fields, BEAMS, "class C:\n    def __init__(self, *, a, b, c, d): ..."),
    (positional_fields, BEAMS, "class C:\n    def __init__(self, a, b, c): ..."),
    (positional_fields, BEAMS, f"class C(NamedTuple):{FOUR}"),
    (positional_tuples, BEAMS, f"class C(NamedTuple):{FOUR}\nC(a=1, b=2, c=3, d=4)"),
    (positional_tuples, BEAMS, "from companion.values import Frame\nFrame(**fields)"),
    (positional_tuples, BEAMS, "from elsewhere import Frame\nFrame(1, 2, 3, 4)"),
    (positional_tuples, BEAMS, "from companion.values import Source\nSource(1, 2)"),
    (crowded_calls, BEAMS, "f(1, 2, 3, 4, 5, g=6)\nstruct.pack(1, 2, 3, 4, 5, 6)"),
]


@pytest.mark.parametrize(("rule", "path", "text"), GOOD)
def test_rule_accepts_good_code(rule: Rule, path: str, text: str) -> None:
    assert rule(path, text) == []


# --- imports: import-linter ---------------------------------------------------------------------


def lint_imports(root: Path) -> subprocess.CompletedProcess[str]:
    """Run import-linter over the packages at ``root`` with the contracts found there."""
    run = "from importlinter.cli import lint_imports_command; lint_imports_command()"
    command = (sys.executable, "-c", run, "--no-cache")
    return subprocess.run(
        command, cwd=root, capture_output=True, text=True, check=False, timeout=HANG_S
    )


def test_packages_satisfy_the_import_contracts() -> None:
    done = lint_imports(ROOT)
    assert done.returncode == 0, done.stdout + done.stderr


LOCAL = "def f():\n    "
REFUSED = [
    ("companion/beams/bad.py", "import companion.tracking", "companion.tracking"),
    ("companion/mavlink/bad.py", "import companion.beams", "companion.beams"),
    (
        "companion/tracking/bad.py",
        f"{LOCAL}from companion.mavlink import framing",
        "companion.mavlink",
    ),
    (VALUES, "import companion.beams", "companion.beams"),
    ("companion/recording/bad.py", "import companion.server", "companion.server"),
    ("companion/server/bad.py", "import sitl_replay", "sitl_replay"),
    ("companion/studies/bad.py", "import companion.server", "companion.server"),
    ("companion/tracking/heavy.py", f"{LOCAL}import cvxpy", "cvxpy"),
    ("sitl_replay/bad.py", "import cvxpy", "cvxpy"),
    ("companion/studies/heavy.py", f"{LOCAL}import torch", "torch"),
    ("companion/tracking/learned.py", "from torch import nn", "torch"),
    ("companion/studies/many.py", "import distributed", "distributed"),
    ("companion/node/bad.py", f"{LOCAL}import zenoh", "zenoh"),
]


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the empty packages and the contracts."""
    root = tmp_path_factory.mktemp("bare")
    shutil.copy(ROOT / "pyproject.toml", root)
    for package in PACKAGES:
        for directory in [ROOT / package, *(p.parent for p in (ROOT / package).rglob("*.py"))]:
            room = root / directory.relative_to(ROOT)
            room.mkdir(parents=True, exist_ok=True)
            (room / "__init__.py").touch()
    (root / VALUES).touch()
    assert lint_imports(root).returncode == 0
    return root


@pytest.fixture(scope="module")
def refused(bare: Path) -> str:
    """Return import-linter's output for one violation of each contract."""
    for path, text, _ in REFUSED:
        (bare / path).write_text(text, encoding="utf-8")
    done = lint_imports(bare)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "BROKEN" in done.stdout
    return " ".join(done.stdout.split())


@pytest.mark.parametrize(("path", "text", "imported"), REFUSED)
def test_import_linter_rejects_forbidden_imports(
    refused: str, path: str, text: str, imported: str
) -> None:
    module = path.removesuffix(".py").replace("/", ".")
    assert f"- {module} -> {imported} (l.{text.count(chr(10)) + 1})" in refused


def test_service_loads_neither_solver_nor_study_packages() -> None:
    """``companion run`` imports neither CVXPY nor the packages for figures and pages."""
    if not (ROOT / "companion/node/service.py").exists():
        pytest.skip("there is no companion/node/service.py yet")
    run = (
        "import sys, companion.cli.main, companion.node.service\n"
        "print(*{'cvxpy', 'jinja2', 'matplotlib'} & set(sys.modules))"
    )
    done = subprocess.run(
        (sys.executable, "-c", run), cwd=ROOT, capture_output=True, check=False, timeout=HANG_S
    )
    assert (done.returncode, done.stdout.decode().split()) == (0, []), done.stderr.decode()


# --- tests ------------------------------------------------------------------------------------


WAITS = frozenset(("run", "communicate"))


def endless_waits(text: str) -> list[str]:
    """Calls in a test that may wait forever, each with its replacement."""
    faults: list[str] = []
    if not any(word in text for word in ("Popen", ".run(", ".communicate")):
        return faults
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.With):
            names = [ast.unparse(item.context_expr).partition("(")[0] for item in node.items]
            if "subprocess.Popen" in names:
                faults.append(f"{node.lineno}: with Popen: with support.started")
        if not isinstance(node, ast.Call):
            continue
        if not isinstance(node.func, ast.Attribute) or node.func.attr not in WAITS:
            continue
        name, given = ast.unparse(node.func), {keyword.arg for keyword in node.keywords}
        if name == "asyncio.run":
            faults.append(f"{node.lineno}: asyncio.run: support.run_async")
        if name == "subprocess.run" and "timeout" not in given:
            faults.append(f"{node.lineno}: subprocess.run: timeout=HANG_S")
        if name.endswith(".communicate") and "timeout" not in given:
            faults.append(f"{node.lineno}: communicate: timeout=HANG_S, or support.end")
    return faults


def test_tests_have_no_endless_waits() -> None:
    """Neither for a process nor for a coroutine: nothing else would notice the hang."""
    faults = [
        f"{path.relative_to(ROOT)}:{fault}"
        for path in sorted((ROOT / "tests").rglob("*.py"))
        if path.name != "mutations.py"  # not a test: it runs them
        for fault in endless_waits(path.read_text(encoding="utf-8"))
    ]
    assert faults == []


def test_endless_wait_is_detected() -> None:
    text = (
        "with subprocess.Popen(a) as b:\n    b.communicate()\n    subprocess.run(c)\nasyncio.run(d)"
    )
    assert [fault.partition(": ")[0] for fault in sorted(endless_waits(text))] == [*"1234"]
    assert endless_waits("subprocess.run(a, timeout=HANG_S)\nb.communicate(timeout=HANG_S)") == []


def test_class_names_are_unique() -> None:
    texts = (p.read_text(encoding="utf-8") for p in sorted((ROOT / "companion").rglob("*.py")))
    assert repeated_classes(texts) == sorted(REPEATED_CLASSES)


def test_repeated_classes_and_obscure_names_are_detected() -> None:
    assert repeated_classes(["class A:\n    class B: ...", "class B: ..."]) == ["B"]
    text = "TOLD_S: Final = 1\ndef sure_db(): ...\nclass Twins:\n    def is_insured(self): ..."
    found = obscure_names("companion/pipeline/aside.py", text)
    assert sorted(fault.split(":")[1] for fault in found) == [*"1123"]
    assert obscure_names("sitl_replay/aside.py", text) == []


# --- committed files ----------------------------------------------------------------------------


def registries(data: bytes) -> list[str]:
    """Hosts of package registries named in a file."""
    lowered = data.lower()
    return [host for host in REGISTRY_HOSTS if host.encode() in lowered]


def lock_faults(text: str) -> list[str]:
    """Requirements of a lock without an exact version or hash, and addresses."""
    faults = [line for line in text.splitlines() if "://" in line or line.startswith("-")]
    for entry in text.replace("\\\n", " ").splitlines():
        if entry.strip() and not re.match(r"[\w.-]+==\S+ .*--hash=sha256:[0-9a-f]{64}", entry):
            faults.append(entry)
    return faults


def test_every_mutation_applies_once() -> None:
    for fault in tomllib.loads((ROOT / "tests" / "mutations.toml").read_text())["mutation"]:
        times = (ROOT / fault["file"]).read_text().count(fault["old"])
        assert times == 1, f"{fault['what']}: its text is in {fault['file']} {times} times"
        for tests in fault["tests"]:
            assert (ROOT / tests).exists(), f"{fault['what']}: no {tests}"


def test_committed_files_name_no_registry() -> None:
    paths = committed()
    assert {"LICENSE", "pyproject.toml", *LOCKS} <= set(paths)
    found = {path: registries((ROOT / path).read_bytes()) for path in paths}
    assert not {path: hosts for path, hosts in found.items() if hosts}


@pytest.mark.parametrize("host", REGISTRY_HOSTS)
def test_registry_name_is_detected(host: str) -> None:
    assert registries(f"see HTTPS://files.{host.upper()}/simple".encode())


@pytest.mark.parametrize("lock", LOCKS)
def test_locks_have_versions_and_hashes_and_no_addresses(lock: str) -> None:
    text = (ROOT / lock).read_text(encoding="utf-8")
    assert "numpy==" in text
    assert lock_faults(text) == []


@pytest.mark.parametrize(
    "text",
    [
        "numpy==2.0.0\n",
        "numpy>=2.0.0 \\\n    --hash=sha256:" + "0" * 64 + "\n",
        "numpy @ https://example.test/numpy.whl \\\n    --hash=sha256:" + "0" * 64 + "\n",
        "--index-url somewhere\n",
        "numpy==2.0.0 \\\n    --hash=md5:" + "0" * 32 + "\n",
    ],
)
def test_invalid_lock_is_detected(text: str) -> None:
    assert lock_faults(text)


def test_locks_pin_every_dependency() -> None:
    """Every dependency in ``pyproject.toml`` is pinned."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    wanted = {
        "requirements.lock": [
            *project["project"]["dependencies"],
            *project["build-system"]["requires"],
            *project["dependency-groups"]["build"],
        ],
        "requirements-dev.lock": project["project"]["optional-dependencies"]["dev"],
    }
    for lock, requirements in wanted.items():
        pinned = set(re.findall(r"^([\w.-]+)==", (ROOT / lock).read_text("utf-8"), re.MULTILINE))
        names = {re.split(r"[^\w.-]", requirement)[0] for requirement in requirements}
        assert names <= pinned, f"{lock} lacks {names - pinned}: run `make lock`"


@pytest.mark.parametrize(
    ("kind", "text", "subject"),
    [
        ("error", "not a good thing", "UserError"),
        ("error", "array: " + "x" * 200, "UserError"),
        ("error", "array: two\nlines", "UserError"),
        ("notice", "clock moved by 30 ms", ""),
    ],
)
def test_a_text_that_breaks_a_rule_is_found(kind: str, text: str, subject: str) -> None:
    assert list(broken_rules(kind=kind, text=text, subject=subject, place=""))


def test_an_error_in_three_parts_keeps_the_rules() -> None:
    text = "array.coupling: matrix is nearly singular (condition number 2e7); give measured values"
    assert not list(broken_rules(kind="error", text=text, subject="UserError", place=""))


def test_the_list_of_texts_has_every_kind() -> None:
    """docs/messages.md, from which errors and notices are listed, is what the tests collect."""
    command = [sys.executable, ROOT / "docs" / "list_texts.py", "messages", "help", "page"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=HANG_S)
    counted = {kind: int(count) for count, kind in map(str.split, done.stderr.splitlines())}
    assert set(counted) == {"error", "notice", "detail", "rest", "help", "page"}
    assert counted["error"] > 300 and counted["rest"] < 80


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("{tmp}/pytest-of-me/pytest-7/popen-gw0/test_a0/x.mcap: is empty", "x.mcap: is empty"),
        ("{tmp}/pytest-of-me/pytest-7/test_a0: is a folder", "folder: is a folder"),
        ("{tmp}/tmp0w_g/x.mcap: is empty", "x.mcap: is empty"),
        ("{root}/tests/data/x.tlog: is empty", "tests/data/x.tlog: is empty"),
        ("/dev/zero: not a file", "/dev/zero: not a file"),
    ],
)
def test_listed_text_has_no_folder_of_the_test_machine(text: str, shown: str) -> None:
    sys.path.insert(0, str(ROOT / "docs"))
    import list_texts

    collected = text.format(tmp=tempfile.gettempdir(), root=ROOT)
    assert list_texts.example(collected) == shown
    written = list_texts.MESSAGES.read_text(encoding="utf-8")
    assert not re.search(rf"{ROOT}|{tempfile.gettempdir()}/|pytest", written)


def test_every_error_of_the_code_is_in_the_list_of_texts() -> None:
    """An error that was reworded or added is not listed until `make messages` is run."""
    sys.path.insert(0, str(ROOT / "docs"))
    import list_texts

    written = list_texts.MESSAGES.read_text(encoding="utf-8")
    missing = [one for one in list_texts.raised() if list_texts.listed(one.fixed) not in written]
    assert not missing, f"run `make messages`: {missing[:3]}"
