"""List every text that a person can read, for translators and reviewers.

    python docs/list_texts.py [KIND...]          print the texts, tab-separated; then the counts
    python docs/list_texts.py --draw SEED        print a sample of 60 for a fresh reader
    python docs/list_texts.py --collected FILE   rewrite docs/messages.md from a test run

Errors, notices and rejection details are listed as users see them, with realistic values: `make
messages` runs the tests with COLLECT_TEXTS=FILE, which keeps each of these texts (see
tests/collected_texts.py). The others are read from where they stand.
"""

import ast
import json
import random
import re
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, Final, NamedTuple

import click
from make_api import answer, document

ROOT: Final = Path(__file__).resolve().parents[1]
MESSAGES: Final = ROOT / "docs" / "messages.md"
EXAMPLES_MAX: Final = 4  # of one place in the code
LENGTH_MAX: Final = 250  # of an example; random texts of tests are longer
FIXED_MIN: Final = 6  # characters of a template that tell it from others
SAMPLE: Final = {"error": 15, "notice": 10, "detail": 5, "api": 15, "docstring": 15}
HEAD: Final = """# Errors and notices

Every error, notice and rejection detail, as users see it, with example values from the tests.
[Troubleshooting](troubleshooting.md) explains the common ones. Written by `make messages`.
"""
TITLES: Final = {
    "error": "Errors: a command or a setting that cannot be used",
    "notice": "Notices: events of a running service",
    "detail": "Details of rejections: why a received message was discarded",
    "rest": "Errors that no test causes, without example values",
}


class Text(NamedTuple):
    """A text, its kind, and the file, path or command in which it stands."""

    kind: str
    place: str
    text: str


# --- errors, notices and details ----------------------------------------------------------------


_TEST_FOLDER: Final = re.compile(
    r"/[^ '\":,]*/pytest-of-[^/]*/pytest-\d+/(?:popen-\w+/)?[^/ '\":,]+(/?)"
)


def example(text: str) -> str:
    """Return a collected text without folders and ports of the test machine."""
    text = _TEST_FOLDER.sub(lambda found: "" if found[1] else "folder", text)
    text = re.sub(rf"{tempfile.gettempdir()}/tmp\w+/", "", text).replace(f"{ROOT}/", "")
    text = re.sub(r"(127\.0\.0\.1|\[::1\]|localhost):\d{5}", r"\1:14550", text)
    return listed(text)


def _form(text: str) -> str:
    """Return a text without its values: numbers, names, quotes."""
    text = re.sub(r"'[^']*'|\"[^\"]*\"|\[[^]]*\]|\([^)]*\)", "'", text)
    text = re.sub(r"^[^:]*: ", ": ", text)
    return re.sub(r"[-+\d.][\w.:+-]*|\b\w+:\w+\b", "0", text)


def _chosen(texts: list[str]) -> Iterator[str]:
    """The texts of one place that differ in more than values, the commonest forms first."""
    by_form: dict[str, list[str]] = defaultdict(list)
    for text in texts:
        by_form[_form(text)].append(text)
    for form in sorted(by_form, key=lambda one: (-len(by_form[one]), one))[:EXAMPLES_MAX]:
        yield min(by_form[form], key=lambda one: (abs(len(one) - 80), one))


class Raised(NamedTuple):
    """An error in the code: its template, and the longest part of it without placeholders."""

    place: str
    template: str
    fixed: str


def raised() -> Iterator[Raised]:
    """The errors of users that the code raises, each with a message of its own."""
    modules = list(_modules())
    classes = {"UserError"}
    for _ in range(3):  # subclasses of subclasses
        classes |= {
            node.name
            for _, tree in modules
            for node in ast.walk(tree)
            if isinstance(node, ast.ClassDef)
            and any(isinstance(base, ast.Name) and base.id in classes for base in node.bases)
        }
    for place, tree in modules:
        for node in ast.walk(tree):
            match node:
                case ast.Raise(exc=ast.Call(func=ast.Name(id=name), args=[text])) if (
                    name in classes
                ):
                    template, parts = _template(text)
                    fixed = max(parts, key=len, default="")
                    if len(fixed) >= FIXED_MIN:
                        yield Raised(place, template, fixed)


def _template(text: ast.expr) -> tuple[str, list[str]]:
    match text:
        case ast.Constant(value=str(words)):
            return words, [words]
        case ast.JoinedStr(values=values):
            parts = [one.value for one in values if isinstance(one, ast.Constant)]
            shown = [str(one.value) if isinstance(one, ast.Constant) else "…" for one in values]
            return "".join(shown), [str(one) for one in parts]
    return "", []


def listed(text: str) -> str:
    """A text as docs/messages.md writes it."""
    return text.replace("|", "\\|").replace("`", "'")


def write_messages(collected: Path) -> None:
    """Write docs/messages.md from what a run of the tests collected."""
    places: dict[tuple[str, str], list[str]] = defaultdict(list)
    for line in sorted(set(collected.read_text(encoding="utf-8").splitlines())):
        found = json.loads(line)
        text = example(found["text"])
        if text.isascii() and text.isprintable() and len(text) <= LENGTH_MAX:
            places[found["kind"], found["place"]].append(text)
    parts = [HEAD]
    for kind, title in list(TITLES.items())[:-1]:
        parts.append(f"\n## {title}\n")
        rooms: dict[str, set[str]] = defaultdict(set)
        for (of, place), texts in places.items():
            if of == kind:
                rooms["/".join(place.split("/")[:-1])].update(_chosen(texts))
        for room in sorted(rooms):
            parts.append(f"\n### {room}\n\n")
            parts.extend(f"- `{text}`\n" for text in sorted(rooms[room]))
    written = "".join(parts)
    rest = {listed(one.template) for one in raised() if listed(one.fixed) not in written}
    parts.append(f"\n## {TITLES['rest']}\n\n### all\n\n")
    parts.extend(f"- `{text}`\n" for text in sorted(rest))
    MESSAGES.write_text("".join(parts), encoding="utf-8")


def messages() -> Iterator[Text]:
    """The errors, notices and details of docs/messages.md."""
    kind = room = ""
    for line in MESSAGES.read_text(encoding="utf-8").splitlines():
        if line.startswith("## "):
            kind = next(one for one, title in TITLES.items() if line == f"## {title}")
        elif line.startswith("### "):
            room = line[4:]
        elif line.startswith("- "):
            yield Text(kind, room, line[3:-1])


# --- commands, API and metrics ------------------------------------------------------------------


def _commands(command: click.Command, name: str) -> Iterator[Text]:
    yield Text("help", name, command.help or "")
    for one in command.params:
        if isinstance(one, click.Option) and one.help:
            yield Text("help", f"{name} {one.opts[0]}", one.help)
    if isinstance(command, click.Group):
        for child, below in command.commands.items():
            yield from _commands(below, f"{name} {child}")


def helps() -> Iterator[Text]:
    """What every command and option says with --help."""
    from companion.cli.main import main as companion
    from sitl_replay.cli import main as sitl_replay

    yield from _commands(companion, "companion")
    yield from _commands(sitl_replay, "sitl-replay")


def _described(found: Any, place: str) -> Iterator[Text]:
    if isinstance(found, dict):
        for key in ("summary", "description"):
            if isinstance(found.get(key), str):
                yield Text("api", place, found[key])
        for key, value in found.items():
            yield from _described(value, f"{place}.{key}")
    elif isinstance(found, list):
        for value in found:
            yield from _described(value, place)


def api() -> Iterator[Text]:
    """Summaries and descriptions of the OpenAPI document."""
    seen = set()
    for one in _described(document(), "openapi"):
        if one.text not in seen and not one.place.endswith(".422"):
            seen.add(one.text)
            yield one


def metrics() -> Iterator[Text]:
    """The help of each metric, as /metrics gives it."""
    for line in answer("/metrics").text.splitlines():
        if line.startswith("# HELP"):
            _, _, name, text = line.split(" ", 3)
            yield Text("metrics", name, text)


# --- the page -----------------------------------------------------------------------------------


class _Html(HTMLParser):
    """Texts of a page: what stands between tags, and attributes that are shown or spoken."""

    def __init__(self, place: str) -> None:
        super().__init__()
        self.place, self.found = place, list[Text]()
        self._within = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._within = tag
        for name, value in attrs:
            if name in ("title", "aria-label", "placeholder", "alt") and value:
                self.found.append(Text("page", self.place, value))

    def handle_data(self, data: str) -> None:
        if data.strip() and self._within not in ("script", "style"):
            self.found.append(Text("page", self.place, " ".join(data.split())))


def page() -> Iterator[Text]:
    """Labels, tooltips and advice of the dashboard: its HTML, and texts in its scripts."""
    for path in sorted((ROOT / "web").glob("*.html")):
        parser = _Html(path.name)
        parser.feed(path.read_text(encoding="utf-8"))
        yield from parser.found
    for path in sorted((ROOT / "web").glob("*.js")):
        for text in _script_texts(path.read_text(encoding="utf-8")):
            yield Text("page", path.name, text)


_SCRIPT: Final = re.compile(
    r"""//[^\n]* | /\*.*?\*/ | "((?:[^"\\\n]|\\.)*)" | '((?:[^'\\\n]|\\.)*)'
    | `((?:[^`\\$] | \\. | \$(?!\{) | \$\{(?:[^{}`]|\{[^{}]*\}|`[^`]*`)*\})*)`""",
    re.VERBOSE | re.DOTALL,
)
_CODE: Final = re.compile(r"[#.][a-z]|\[[a-z-]+|=>|^\(|^v1/|^[a-z]+, [a-z]+$|px |^[\d. ]+$|var\(--")


def _script_texts(code: str) -> Iterator[str]:
    """The string literals of a script that read like words."""
    for found in _SCRIPT.finditer(code):
        text = " ".join((found[1] or found[2] or found[3] or "").split())
        words = re.sub(r"\$\{[^}]*\}", "", text)
        if re.search(r"[A-Za-z]{3}", words) and " " in text and not _CODE.search(words):
            yield text


# --- texts in files -----------------------------------------------------------------------------


def documents() -> Iterator[Text]:
    """Paragraphs, list items and table rows of README, CHANGELOG and docs/."""
    for path in sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]):
        if path != MESSAGES:
            text = re.sub(r"^```.*?^```", "", path.read_text("utf-8"), flags=re.M | re.S)
            for block in re.split(r"\n\s*\n|\n(?=[-|#] ?)", text):
                if re.search(r"[a-z]{3}", block):
                    yield Text("docs", str(path.relative_to(ROOT)), " ".join(block.split()))


def comments_of_settings() -> Iterator[Text]:
    """Comments of example settings and of the container's files."""
    listed = ("examples/**/*.toml", "examples/**/*.json5", "docker-compose.yml", "Dockerfile")
    for path in sorted(each for one in listed for each in ROOT.glob(one)):
        for comment in re.findall(r"(?:^|\s)(?:#|//) ?(.+)$", path.read_text("utf-8"), re.M):
            yield Text("example", str(path.relative_to(ROOT)), comment)


def _modules() -> Iterator[tuple[str, ast.Module]]:
    for room in ("companion", "sitl_replay"):
        for path in sorted((ROOT / room).rglob("*.py")):
            yield str(path.relative_to(ROOT)), ast.parse(path.read_text(encoding="utf-8"))


def docstrings() -> Iterator[Text]:
    """Docstrings of modules, classes, functions, and of the constants and fields above them."""
    for place, tree in _modules():
        for node in ast.walk(tree):
            owner = getattr(node, "name", "")
            for before, one in zip([None, *_body(node)], _body(node), strict=False):
                match one:
                    case ast.Expr(value=ast.Constant(value=str(text))):
                        name = ast.unparse(before).partition(" =")[0] if before else ""
                        where = f"{place}::{'.'.join(filter(None, (owner, name[:60])))}"
                        yield Text("docstring", where, " ".join(text.split()))


def _body(node: ast.AST) -> list[ast.stmt]:
    body = getattr(node, "body", [])
    return body if isinstance(body, list) else []


KINDS: Final[dict[str, Callable[[], Iterator[Text]]]] = {
    "messages": messages,
    "help": helps,
    "api": api,
    "metrics": metrics,
    "page": page,
    "docs": documents,
    "example": comments_of_settings,
    "docstring": docstrings,
}


def draw(seed: int) -> list[Text]:
    """Return the sample of a seed, by kind."""
    of_kind: dict[str, list[Text]] = defaultdict(list)
    for one in (*messages(), *api(), *docstrings()):
        of_kind[one.kind].append(one)
    random_ = random.Random(seed)
    return [one for kind, count in SAMPLE.items() for one in random_.sample(of_kind[kind], count)]


def main(words: list[str]) -> None:
    """Do what the words of the command line ask for."""
    match words:
        case ["--collected", file]:
            write_messages(Path(file))
        case ["--draw", seed]:
            for number, one in enumerate(draw(int(seed)), 1):
                print(f"{number}. [{one.kind}] {one.text}")
        case _:
            found = [one for kind in words or KINDS for one in KINDS[kind]()]
            for one in found:
                print("\t".join(one))
            for kind, count in Counter(one.kind for one in found).items():
                print(f"{count} {kind}", file=sys.stderr)


if __name__ == "__main__":
    main(sys.argv[1:])
