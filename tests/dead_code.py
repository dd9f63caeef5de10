"""Dead code, by vulture; what is described leaves the program by its description and is used.

    python tests/dead_code.py

A field or property with a ``Meaning`` is read by name (``companion.values.described``), which no
search of the text can see. Status as vulture's.
"""

import ast
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def described(tree: ast.AST) -> Iterator[str]:
    """The names of fields and properties whose annotation says what they mean."""
    for node in ast.walk(tree):
        match node:
            case ast.AnnAssign(target=ast.Name(id=name), annotation=kind):
                pass
            case ast.FunctionDef(name=name, returns=kind) if kind is not None:
                pass
            case _:
                continue
        if ast.unparse(kind).startswith("Annotated["):
            yield name


def main() -> int:
    """Run vulture over the paths of pyproject.toml and the described names."""
    names = {
        name
        for path in (ROOT / "companion").rglob("*.py")
        for name in described(ast.parse(path.read_text(encoding="utf-8")))
    }
    with tempfile.TemporaryDirectory() as folder:
        allowed = Path(folder) / "described.py"
        allowed.write_text("".join(f"_.{name}\n" for name in sorted(names)), encoding="utf-8")
        paths = ["companion", "sitl_replay", "tests/vulture_allowed.py", str(allowed)]
        command = [sys.executable, "-m", "vulture", *paths]
        return subprocess.run(command, cwd=ROOT, check=False, timeout=300).returncode


if __name__ == "__main__":
    sys.exit(main())
