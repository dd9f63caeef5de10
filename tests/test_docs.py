"""The documents are correct: every link, name, figure and citation exists."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from support import HANG_S, ROOT

from companion.values import Cause, Reason

DOCS = ROOT / "docs"
PAGES = sorted([*DOCS.rglob("*.md"), *ROOT.glob("*.md")])
CODE = [
    path for room in ("companion", "sitl_replay", "tests") for path in (ROOT / room).rglob("*.py")
]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_target_exists(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8")):
        if "://" not in target:
            assert (page.parent / target).exists(), target


def test_every_path_named_in_the_architecture_exists() -> None:
    """``a/b.py`` is below companion/; a bare ``b.py`` is in a folder named before it."""
    text = (DOCS / "architecture.md").read_text(encoding="utf-8")
    named = re.findall(r"`([\w./-]+)`", text)
    rooms = ("companion", "sitl_replay", "web", "docs", "tests")
    tree = {str(path.relative_to(ROOT)) for room in rooms for path in (ROOT / room).rglob("*.*")}
    tree |= {path.name for path in ROOT.iterdir()}
    for name in named:
        if name.endswith((".py", ".js", ".toml")):
            assert any(there.endswith(f"/{name}") or there == name for there in tree), name
        elif "/" in name:
            assert (ROOT / "companion" / name).is_dir() or (ROOT / name).exists(), name


@pytest.mark.full
def test_package_diagram_is_up_to_date() -> None:
    drawing = [sys.executable, DOCS / "draw_architecture.py", "--check"]
    done = subprocess.run(drawing, capture_output=True, text=True, check=False, timeout=HANG_S)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "drawn",
    [
        "make_api.py",
        "make_export.py",
        "make_notice.py",
        pytest.param("make_researcher.py", marks=pytest.mark.full),
    ],
)
def test_generated_page_is_up_to_date(drawn: str) -> None:
    """The API reference, the list of redistributed software, and the notebook with its executed
    cells."""
    making = [sys.executable, DOCS / drawn, "--check"]
    done = subprocess.run(making, capture_output=True, text=True, check=False, timeout=HANG_S)
    assert done.returncode == 0, done.stderr


def test_every_threat_cites_an_existing_test() -> None:
    rows = re.findall(r"^\|.*\| `?([^|`]*)`? \|$", (DOCS / "security.md").read_text("utf-8"), re.M)
    cited = [one for one in rows if one not in ("test", "---") and not one.startswith("---")]
    assert len(cited) > 20
    for one in cited:
        file, _, name = one.partition("::")
        assert f"def {name}(" in (ROOT / file).read_text(encoding="utf-8"), one


READ_BACK = {"companion/views/tables/said.py", "companion/recording/entries.py"}
"""Code that recreates notices published by others."""


def rows(heading: str) -> list[list[str]]:
    """Return the cells of the first table under a heading of the troubleshooting page."""
    text = (DOCS / "troubleshooting.md").read_text(encoding="utf-8").split(f"## {heading}\n")[1]
    table = [line for line in text.split("\n## ")[0].splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table[2:]]


def test_documented_rejection_reasons_are_complete() -> None:
    named = [word for row in rows("Reports are rejected") for word in row[0].split(", ")]
    assert sorted(named) == sorted(f"`{reason}`" for reason in Reason)


def test_every_cause_of_a_weak_link_is_documented() -> None:
    told = [cause for row in rows("A link is weak, or none") for cause in row[0].split(", ")]
    assert sorted(told) == sorted(f"`{cause}`" for cause in Cause)


def test_every_notice_subject_is_documented() -> None:
    text = (DOCS / "troubleshooting.md").read_text(encoding="utf-8")
    said = {one for row in rows("Notices") for one in re.findall(r'"(.+?)"', row[0])}
    said |= set(re.findall(r'"([^"]+)"', text.split("## A fleet\n")[1].split("\n## ")[0]))
    sources = {
        path: path.read_text(encoding="utf-8") for path in (ROOT / "companion").rglob("*.py")
    }
    for phrase in said:
        words = phrase.split(" … ")[-1]
        assert any(words in source for source in sources.values()), phrase
    makes = {
        path for path, source in sources.items() if re.search(r"(?<!class )\bNotice\(", source)
    }
    untold = {
        path.relative_to(ROOT).as_posix()
        for path in makes
        if not any(phrase.split(" … ")[-1] in sources[path] for phrase in said)
    }
    assert untold == READ_BACK


def test_package_has_at_most_twelve_subpackages() -> None:
    inside = (ROOT / "companion").iterdir()
    there = {path.name for path in inside if path.name not in ("__pycache__", "_web")}
    files = {name for name in there if name.endswith(".py")}
    assert files == {"__init__.py", "__main__.py", "client.py"}
    assert len(there - files) <= 12


def test_every_decision_is_listed() -> None:
    index = (DOCS / "decisions" / "README.md").read_text(encoding="utf-8")
    pages = {path.name for path in (DOCS / "decisions").glob("[0-9]*.md")}
    assert pages == set(re.findall(r"\(([^)]+)\)", index))


def headings(page: str) -> set[str]:
    """Return the numbers of a page's sections."""
    text = (DOCS / page).read_text(encoding="utf-8")
    return {found.rstrip(".") for found in re.findall(r"^#+ ([\d.]+) ", text, re.MULTILINE)}


@pytest.mark.parametrize("page", ["math.md", "field-notes.md"])
def test_every_cited_section_exists(page: str) -> None:
    there, cited = headings(page), set()
    one = r"\d+(?:\.\d+)?"
    for path in CODE:
        for listed in re.findall(
            rf"docs/{re.escape(page)}[ ,]+(?:section )?({one}(?:(?:,| and) {one})*)",
            unwrapped(path),
        ):
            cited |= set(re.findall(one, listed))
    assert cited <= there, cited - there


def test_every_cited_paper_equation_is_in_the_mathematics_page() -> None:
    there = equations(DOCS / "math.md")
    for path in CODE:
        assert equations(path) <= there, path


@pytest.mark.parametrize(
    "path",
    [
        "tracking/observers/position.py", "tracking/observers/kinematic.py",
        "tracking/design/closed_form.py", "tracking/design/lmi.py", "beams/array/steering.py",
        "beams/weights/zero_forcing.py", "beams/weights/precoding.py", "beams/worth/channel.py",
    ],
)  # fmt: skip
def test_the_code_of_the_method_cites_its_equations(path: str) -> None:
    assert equations(ROOT / "companion" / path)


def equations(path: Path) -> set[str]:
    """Return the numbers of the paper equations that a file cites."""
    return set(re.findall(r"paper eq\. \((\d+)\)", unwrapped(path)))


def unwrapped(path: Path) -> str:
    """Return the text of a file with comments and paragraphs on one line."""
    return re.sub(r"\s*\n\s*#?\s*", " ", path.read_text(encoding="utf-8"))


def test_every_class_in_the_glossary_exists() -> None:
    text = (DOCS / "glossary.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`([A-Z][a-z]+[A-Za-z]*)(?:\.\w+)*`", text))
    sources = "".join(
        path.read_text(encoding="utf-8") for path in (ROOT / "companion").rglob("*.py")
    )
    defined = set(re.findall(r"^class (\w+)", sources, re.MULTILINE))
    assert len(named) > 40
    assert named <= defined, named - defined


@pytest.mark.parametrize(
    ("what", "neighbour"),
    [
        ("a position message", "HIGH_LATENCY2|alt_step_m"),
        ("an array geometry", r"HEXAGONAL|hexagonal|given\.rings"),
        ("a field of the API, recordings and exports", "climb_rate_mps"),
    ],
)
def test_extension_table_names_every_affected_file(what: str, neighbour: str) -> None:
    """The most recent addition appears in the files of the table, and in at most four."""
    text = (DOCS / "architecture.md").read_text(encoding="utf-8")
    (row,) = (line for line in text.splitlines() if line.startswith(f"| {what} |"))
    named = set(re.findall(r"`([\w/]+\.\w+)`", row))
    sources = [*(ROOT / "companion").rglob("*.py"), *(ROOT / "web").glob("*.js")]
    inside = {
        path.relative_to(ROOT).as_posix().removeprefix("companion/")
        for path in sources
        if re.search(rf"\b({neighbour})\b", path.read_text(encoding="utf-8"))
    }
    assert inside <= named, inside - named
    assert len(inside) <= 4
