"""The public interface: names for notebooks and external programs, and the docstring example."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest
from support import HANG_S, ROOT

import companion


def loaded_by(code: str) -> set[str]:
    """Return the modules that a fresh interpreter has loaded after running some code."""
    run = f"{code}\nimport sys\nprint(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", run], capture_output=True, text=True, check=True, timeout=HANG_S
    )
    return set(done.stdout.splitlines()[-1].split())


def test_every_public_name_exists_and_is_documented() -> None:
    assert companion.__doc__ is not None
    for name in companion.__all__:
        assert getattr(companion, name) is not None
        assert name == "__version__" or f"``{name}" in companion.__doc__
    with pytest.raises(AttributeError, match="no attribute 'Beams'"):
        _ = companion.Beams


def test_type_checking_imports_match_lazy_imports() -> None:
    """The imports under TYPE_CHECKING are the objects that lazy loading returns."""
    tree = ast.parse(Path(companion.__file__).read_text(encoding="utf-8"))
    under = next(node for node in tree.body if isinstance(node, ast.If))
    found = {
        name.name: node.module
        for node in under.body
        if isinstance(node, ast.ImportFrom)
        for name in node.names
    }
    assert set(found) == set(companion.__all__) - {"__version__"}
    for name, module in found.items():
        assert getattr(companion, name) is getattr(__import__(module, fromlist=[name]), name)


def test_importing_the_package_loads_no_heavy_modules() -> None:
    bare = loaded_by("pass")
    loaded = loaded_by("import companion")
    assert {name for name in loaded - bare if name.startswith("companion")} == {"companion"}
    assert not (loaded - bare) & {"numpy", "scipy", "pydantic", "pymavlink", "asyncio", "typing"}


def test_package_docstring_example_runs(cut_log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert companion.__doc__ is not None
    example = companion.__doc__.split("::\n\n")[1].split("\n\n``Settings``")[0]
    lines = [line.removeprefix("    ") for line in example.splitlines()]
    code = "\n".join(lines).replace('"flight.tlog"', repr(str(cut_log)))
    exec(compile(code, "the example", "exec"), {})
    said = capsys.readouterr().out.splitlines()
    assert {line.split()[0] for line in said[:-1]} >= {"1:1", "2:1", "3:1", "4:1"}
    assert said[-1].endswith("(64, 4)")
    assert (ROOT / "companion/__init__.py").read_text("utf-8").count("from companion import") == 1
