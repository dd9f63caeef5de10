"""Client of the service for a notebook or a radio's controller, with answers as plain values.

    node = Client("http://127.0.0.1:8080")
    weights = node.weights(lead_ms=20)      # M×N complex, one column a UAV
    for message in node.stream(topics=["beams"], rate_hz=20):
        ...

Synchronous; needs only the standard library, numpy and websockets. For use by one thread.

Over 300 lines: the whole API in one module, beside which a program needs no other.
"""

import base64
import io
import json
import math
import socket
import time
import urllib.error
import urllib.request
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from http.client import HTTPConnection, HTTPException, HTTPResponse, HTTPSConnection, IncompleteRead
from typing import Any, Final, Required, TypedDict
from urllib.parse import quote, urlencode, urlsplit

import numpy as np
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.sync.client import connect

from companion.values import ComplexArray, UserError, shown
from companion.values.numbers import NPY_ERRORS

Json = dict[str, Any]

SUBPROTOCOL: Final = "companion.v1"
ANSWER_MAX: Final = 1 << 28  # longest answer, bytes; 4 million weights take a quarter of it
TEXT_MAX: Final = 1 << 25  # longest answer that is text, bytes
VALUES_MAX: Final = 1 << 20  # most values, or lines, of such an answer; each takes 100 bytes
PIECE_BYTES: Final = 1 << 16
_READ_HEADER: Final = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


class ServiceError(Exception):
    """The service rejected the request, failed, or could not be reached.

    ``status`` is the HTTP status, or the close code of a stream; None without an answer. ``title``
    is the reason.
    """

    def __init__(self, status: int | None, title: str) -> None:
        super().__init__(title if status is None else f"{status}: {title}")
        self.status = status
        self.title = title


@dataclass(frozen=True, slots=True, kw_only=True)
class Weights:
    """Weights from one answer of the service.

    uavs         names of the N UAVs
    matrix       (M, N) complex, columns in the order of ``uavs``
    valid_at_ns  time of application, ns since the Unix epoch on the service's clock
    groups       the time slot of each UAV
    """

    uavs: tuple[str, ...]
    matrix: ComplexArray
    valid_at_ns: int
    groups: tuple[int, ...] = ()


class Measurement(TypedDict, total=False):
    """One measurement of an array's receiver, with the fields of ``POST /v1/observations``.

    Give ``measured_at`` (RFC 3339, UTC) or ``age_s``. For a direction give ``azimuth_deg``,
    ``elevation_deg`` and ``bound_deg``; for powers ``beams``, ``powers_db`` and
    ``power_bound_db``, and ``update`` if the weights of an update were used. docs/api.md describes
    each field.
    """

    uav: Required[str]
    measured_at: str
    age_s: float
    time_bound_s: float
    azimuth_deg: float
    elevation_deg: float
    bound_deg: float
    update: int
    beams: Sequence[int]
    powers_db: Sequence[float]
    power_bound_db: float


class Client:
    """Connection to one service over HTTP and WebSocket.

        url        ``http://HOST:PORT``; raises ``UserError`` for any other form
        token      bearer token, if the service requires one
        timeout_s  timeout for connecting and for each answer

    Every method raises ``ServiceError``.
    """

    def __init__(self, url: str, token: str | None = None, timeout_s: float = 10.0) -> None:
        if not _is_address(url):
            raise UserError(f"{shown(url)} is not http://HOST:PORT")
        self._url = url.rstrip("/")
        self._token = None if token is None else token.strip()  # a file may add a line end
        self._timeout_s = timeout_s

    def fleet(self) -> Json:
        """Return ``/v1/fleet``: the nodes of the fleet and the UAVs that each serves."""
        return self.get("/v1/fleet")

    def status(self) -> Json:
        """Return ``/v1/status``: version, uptime, links, center, recording, rates."""
        return self.get("/v1/status")

    def uavs(self) -> list[Json]:
        """Return every UAV in its present state."""
        found: list[Json] = self.get("/v1/uavs")["uavs"]
        return found

    def beams(self, lead_ms: float = 0.0) -> Json:
        """Return ``/v1/beams``: the beams that will be applied in ``lead_ms`` milliseconds."""
        return self.get("/v1/beams", lead_ms=lead_ms)

    def weights(self, lead_ms: float = 0.0) -> Weights:
        """Return the weights to apply in ``lead_ms`` milliseconds."""
        query = urlencode({"lead_ms": lead_ms})
        with self._open(f"/v1/beams/weights?{query}", "application/x-npy") as answer:
            body, headers = _read(answer, self._timeout_s, ANSWER_MAX), answer.headers
        try:
            return Weights(
                uavs=tuple(name for name in headers.get("x-uavs", "").split(",") if name),
                matrix=_matrix(body),
                valid_at_ns=int(headers.get("x-valid-at-ns", "")),
                groups=tuple(int(slot) for slot in headers.get("x-groups", "").split(",") if slot),
            )
        except NPY_ERRORS as error:
            reason = f"the weights are malformed: {shown(str(error))}"
            raise ServiceError(None, reason) from error

    def table(self, media_type: str, lead_ms: float = 0.0) -> str:
        """Return the weights to apply in ``lead_ms`` milliseconds, as text for a device."""
        query = urlencode({"lead_ms": lead_ms})
        with self._open(f"/v1/beams/weights?{query}", media_type) as answer:
            body = _read(answer, self._timeout_s, TEXT_MAX)
        if body.count(b"\n") > VALUES_MAX:
            raise ServiceError(None, f"the answer exceeds {VALUES_MAX} lines")
        return body.decode(errors="replace")

    def observe(self, measured: Measurement | Sequence[Measurement]) -> Json:
        """Give measurements of the array's receiver: one, or a list of at most 400.

            client.observe({"uav": "3:1", "age_s": 0.01,
                            "azimuth_deg": 12.5, "elevation_deg": -3.0, "bound_deg": 2.0})

        Returns the numbers of ``accepted`` and ``dropped`` ones, and ``errors``: the ``item`` and
        the reason of each invalid one. If none is accepted, ``ServiceError`` has the first reason.
        """
        try:
            body = json.dumps(measured, allow_nan=False, default=_plain).encode()
        except (ValueError, TypeError) as error:
            raise UserError(f"observation: {error}") from error
        with self._open("/v1/observations", "application/json", body) as answer:
            return self._object(_read(answer, self._timeout_s, TEXT_MAX))

    def get(self, path: str, **query: object) -> Json:
        """Return the answer of any path of the API that returns a JSON object."""
        address = quote(path) + ("?" + urlencode(query, doseq=True) if query else "")
        with self._open(address, "application/json") as answer:
            return self._object(_read(answer, self._timeout_s, TEXT_MAX))

    def _object(self, body: bytes) -> Json:
        if sum(map(body.count, (b",", b"[", b"{"))) > VALUES_MAX:
            raise ServiceError(None, f"the answer exceeds {VALUES_MAX} values")
        try:
            found = json.loads(body)
        except (ValueError, RecursionError) as error:
            raise ServiceError(None, f"{self._url}: the answer is not JSON") from error
        if not isinstance(found, dict):
            raise ServiceError(None, f"{self._url}: the answer is not a JSON object")
        return found

    def stream(
        self, uavs: Iterable[str] = (), topics: Iterable[str] = (), rate_hz: float = 10.0
    ) -> Iterator[Json]:
        """Yield messages of the state as it changes; ``companion.server.stream`` describes them.

        A slow consumer misses some. Close the iterator to end the stream. If the service ends,
        ``ServiceError`` is raised with the status 1012.
        """
        topics = tuple(topics)
        if "records" in topics:
            raise UserError("topic 'records' is binary; use Client.records")
        with closing(self._messages(uavs, topics, rate_hz)) as messages:
            for message in messages:
                yield json.loads(message)

    def records(self, uavs: Iterable[str] = (), rate_hz: float = 100.0) -> Iterator[bytes]:
        """Yield updates as they are computed, each as one record (``companion.views.records``).

        Arguments and errors are those of ``stream``.
        """
        with closing(self._messages(uavs, ["records"], rate_hz)) as messages:
            for message in messages:
                assert isinstance(message, bytes)
                yield message

    def _messages(
        self, uavs: Iterable[str], topics: Iterable[str], rate_hz: float
    ) -> Generator[str | bytes, None, None]:
        asked = urlencode({"uav": list(uavs), "topic": list(topics), "rate_hz": rate_hz}, True)
        address = f"ws{self._url.removeprefix('http')}/v1/stream?{asked}"
        protocols: Any = [SUBPROTOCOL]
        if self._token is not None:
            token = base64.urlsafe_b64encode(self._token.encode()).decode().rstrip("=")
            protocols.append(f"bearer.{token}")
        try:
            with connect(
                address,
                subprotocols=protocols,
                open_timeout=self._timeout_s,
                max_size=TEXT_MAX,
                max_queue=1,
                compression=None,
                proxy=None,
            ) as websocket:
                yield from websocket
        except ConnectionClosed as error:
            raise _closed(error) from error
        except (OSError, WebSocketException) as error:
            raise ServiceError(None, f"{self._url}: {error}") from error

    def _open(self, address: str, accept: str, body: bytes | None = None) -> HTTPResponse:
        """Send a request, with POST if it has a body of JSON."""
        headers = {"accept": accept}
        if body is not None:
            headers["content-type"] = "application/json"
        if self._token is not None:
            headers["authorization"] = f"Bearer {self._token}"
        request = urllib.request.Request(self._url + address, data=body, headers=headers)
        try:
            found: HTTPResponse = _OPENER.open(request, timeout=self._timeout_s)
        except urllib.error.HTTPError as error:
            with error:
                raise ServiceError(error.code, _title(error)) from error
        except (OSError, HTTPException) as error:
            raise ServiceError(None, f"{self._url}: {_reason(error)}") from error
        return found


def _plain(value: Any) -> Any:
    """Return a number or an array of numpy as JSON has it. Raises ``TypeError`` for others."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not JSON")


def _is_address(url: str) -> bool:
    try:
        found = urlsplit(url)
        port, host = found.port, found.hostname or ""
        host.encode("idna")
        host.encode("latin-1")  # as headers are
    except ValueError:  # such as a port beyond 65535, or a label of 64 letters
        return False
    return found.scheme in ("http", "https") and bool(host) and port != 0


def _read(answer: HTTPResponse, timeout_s: float, most: int) -> bytes:
    """Return the body of an answer of at most so many bytes.

    Every piece has a timeout, and the whole body has one too.
    """
    ends_s, body = time.monotonic() + timeout_s, bytearray()
    try:
        while piece := answer.read1(PIECE_BYTES):
            body += piece
            if len(body) > most:
                raise ServiceError(None, f"the answer exceeds {most} bytes")
            if time.monotonic() > ends_s:
                raise ServiceError(None, f"the answer takes longer than {timeout_s:g} s")
        if answer.length:
            raise IncompleteRead(bytes(body), answer.length)
        return bytes(body)
    except (OSError, HTTPException) as error:
        raise ServiceError(None, f"the answer is incomplete: {_reason(error)}") from error


def _matrix(body: bytes) -> ComplexArray:
    """Return the matrix of an ``.npy`` file. Raises an error before memory is allocated for it."""
    file = io.BytesIO(body)
    version = np.lib.format.read_magic(file)
    if version not in _READ_HEADER:
        raise ValueError(f"version {version} of .npy is not supported")
    shape, _, dtype = _READ_HEADER[version](file)
    if dtype.kind != "c" or len(shape) != 2:
        raise ValueError(f"{len(shape)} axes of {dtype}, not a complex matrix")
    if min(shape) < 0 or math.prod(shape) * dtype.itemsize != len(body) - file.tell():
        raise ValueError(f"shape {shape} does not fit into the {len(body)} bytes of the answer")
    matrix: ComplexArray = np.load(io.BytesIO(body), allow_pickle=False)
    return matrix


def _title(error: urllib.error.HTTPError) -> str:
    """Return the title of the problem in an answer; the text of its status without one."""
    try:
        return str(json.loads(error.read(PIECE_BYTES))["title"])
    except (ValueError, LookupError, TypeError, OSError, HTTPException, RecursionError):
        return str(error.reason)


def _reason(error: Exception) -> str:
    return str(getattr(error, "reason", None) or error)


def _closed(error: ConnectionClosed) -> ServiceError:
    if error.rcvd is None:
        return ServiceError(None, "the connection was lost")
    return ServiceError(error.rcvd.code, error.rcvd.reason or "the stream was closed")


# --- HTTP with a time limit for the head of an answer; each byte is in time for a socket ---------


class _TimedFile(io.RawIOBase):
    """Unbuffered file of a socket with a timeout; all reading fails at ``ends_s``."""

    def __init__(self, sock: socket.socket) -> None:
        super().__init__()
        timeout_s = sock.gettimeout()
        assert timeout_s is not None
        self._timeout_s = timeout_s
        self.ends_s = time.monotonic() + timeout_s
        self._sock = sock
        self._file = sock.makefile("rb", buffering=0)  # keeps the socket open

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int | None:
        left_s = self.ends_s - time.monotonic()
        if left_s <= 0:
            raise TimeoutError("timed out")
        self._sock.settimeout(min(left_s, self._timeout_s))
        return self._file.readinto(buffer)

    def close(self) -> None:
        if not self.closed:
            self._file.close()
        super().close()


class _TimedResponse(HTTPResponse):
    """Answer whose head must be complete within the timeout of its connection."""

    def __init__(self, sock: socket.socket, *args: Any, **kwargs: Any) -> None:
        super().__init__(sock, *args, **kwargs)
        self.fp.close()
        self._timed = _TimedFile(sock)
        self.fp = io.BufferedReader(self._timed)

    def begin(self) -> None:
        super().begin()
        self._timed.ends_s = math.inf  # the reader of the body limits its time


class _Connection(HTTPConnection):
    response_class = _TimedResponse


class _TlsConnection(HTTPSConnection):
    response_class = _TimedResponse


class _Handler(urllib.request.HTTPHandler):
    def http_open(self, req: urllib.request.Request) -> HTTPResponse:
        return self.do_open(_Connection, req)


class _TlsHandler(urllib.request.HTTPSHandler):
    def https_open(self, req: urllib.request.Request) -> HTTPResponse:
        return self.do_open(_TlsConnection, req, context=self._context)  # type: ignore[attr-defined]


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, *_: Any) -> None:
        """Follow none: the token is for one service."""


_OPENER: Final = urllib.request.build_opener(
    urllib.request.ProxyHandler({}), _Handler(), _TlsHandler(), _NoRedirect()
)
"""Without the proxies of the environment: they reach no service here, and would get its token."""
