"""The dashboard's files: each is read once, and answered from memory.

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

INDEX: Final = "/index.html"


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


class PageFiles:
    """ASGI application that answers GET with a file; ``paths`` are those of all files."""

    def __init__(self, root: Path) -> None:
        self._files = {
            f"/{file.relative_to(root).as_posix()}": file
            for file in root.rglob("*")
            if file.is_file()
        }
        self._read: dict[str, _File] = {}
        self.paths = frozenset({"/", *self._files})

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
        if found.etag in Headers(scope=scope).get("if-none-match", ""):
            return Response(status_code=304, headers=headers)
        return Response(found.content, media_type=found.media_type, headers=headers)

    def _find(self, path: str) -> _File:
        if path not in self._read:
            content = self._files[path].read_bytes()
            self._read[path] = _File(
                content,
                mimetypes.guess_type(path)[0],
                f'"{hashlib.sha256(content).hexdigest()[:32]}"',
            )
        return self._read[path]
