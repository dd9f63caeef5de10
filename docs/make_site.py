"""Build the documents into build/site, a site that is read without internet or a server.

    python docs/make_site.py

Raises an error where a page links to nothing. What the theme would load from elsewhere, the shim by
which search works in pages opened as files, is taken from ``docs/vendor``.
"""

import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
SITE: Final = ROOT / "build" / "site"
SHIM: Final = re.compile(r"https://[^/\"' ]+/iframe-worker/shim")
LOADS: Final = re.compile(r"""<(?:script|img|iframe|source)\b[^>]*\bsrc=["']?(https?://[^"' >]+)""")
LINKED: Final = re.compile(r"""<link\b[^>]*\bhref=["']?(https?://[^"' >]+)""")


def main() -> None:
    """Build, and see that no page loads anything from elsewhere."""
    zensical = Path(sys.executable).parent / "zensical"
    done = subprocess.run(
        [zensical, "build", "--clean", "--strict"],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode or "No issues found" not in done.stdout + done.stderr:
        sys.exit(f"the documents have faults:\n{done.stdout}{done.stderr}")
    for left in SITE.glob("*.py"):
        left.unlink()  # what draws a page is no page
    shutil.copy(ROOT / "docs" / "vendor" / "iframe-worker.js", SITE / "assets")
    for page in SITE.rglob("*.html"):
        up = "../" * (len(page.relative_to(SITE).parts) - 1)
        text = SHIM.sub(f"{up}assets/iframe-worker.js", page.read_text(encoding="utf-8"))
        if found := LOADS.findall(text) + LINKED.findall(text):
            sys.exit(f"{page.relative_to(SITE)} loads {', '.join(found)}")
        page.write_text(text, encoding="utf-8")
    print(SITE / "index.html")


if __name__ == "__main__":
    main()
