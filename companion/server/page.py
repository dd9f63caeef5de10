"""The dashboard's files: each is read once, and answered from memory.

The page itself, its script and its style sheet are joined (``page_bundle``). Their names change
with their content, so a browser keeps them; every other file is asked for again, by its ETag.

Files that are read for each request, on threads, would let any client delay the beams: no token is
needed for them.
"""

import hashlib
import mimetypes
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocket

import companion
from companion.server.page_bundle import bundled
from companion.server.responses import BodyResponse

INDEX: Final = "/index.html"
FOR_EVER: Final = "public, max-age=31536000, immutable"


def web_directory() -> Path:
    """Return the folder of the dashboard's files: in the installed package, or in a checkout."""
    package = Path(companion.__file__).parent
    installed = package / "_web"
    return installed if installed.is_dir() else package.parent / "web"


@dataclass(frozen=True, slots=True)
class _File:
    content: bytes
    media_type: str | None
    etag: str

    @classmethod
    def of(cls, path: str, content: bytes) -> "_File":
        """Return a file with its type by its name, and the tag of its content."""
        digest = hashlib.sha256(content).hexdigest()[:32]
        return cls(content, mimetypes.guess_type(path)[0], f'W/"{digest}"')


class PageFiles:
    """ASGI application that answers GET with a file; ``paths`` are those of all files."""

    def __init__(self, root: Path) -> None:
        self._files = {
            f"/{file.relative_to(root).as_posix()}": file
            for file in root.rglob("*")
            if file.is_file()
        }
        joined = bundled(root)
        self._read = {path: _File.of(path, content) for path, content in joined.items()}
        self._kept = frozenset(joined) - {INDEX}
        self.paths = frozenset({"/", *self._files, *joined})

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await WebSocket(scope, receive, send).close()  # closed before it is open: 403
        else:
            await self.answer(scope["path"], scope)(scope, receive, send)

    def answer(self, path: str, scope: Scope) -> Response:
        """Return the file of a path. Raises ``HTTPException`` 404 and 405."""
        if path not in self.paths:
            raise HTTPException(404)
        if scope["method"] != "GET":
            raise HTTPException(405, headers={"allow": "GET, HEAD"})
        found = self._find(INDEX if path == "/" else path)
        headers = {"etag": found.etag}
        if path in self._kept:
            headers["cache-control"] = FOR_EVER
        if found.etag in Headers(scope=scope).get("if-none-match", ""):
            return Response(status_code=304, headers=headers)
        return BodyResponse(found.content, media_type=found.media_type, headers=headers)

    def _find(self, path: str) -> _File:
        if path not in self._read:
            self._read[path] = _File.of(path, self._files[path].read_bytes())
        return self._read[path]
