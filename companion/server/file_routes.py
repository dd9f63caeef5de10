"""The routes ``/v1/recordings`` and ``/v1/mavlink``: recorded files, and last messages."""

from functools import partial
from typing import Annotated

from fastapi import FastAPI, HTTPException, Path
from fastapi.responses import Response

from companion.server import models, recordings
from companion.server.byte_ranges import Range, file_answer, file_answers
from companion.server.giving_way import GivingWay
from companion.server.large_answers import LargeAnswers, Make
from companion.server.playback import BusyError, Playback, PlaybackError, Reading
from companion.server.responses import answer, answers, encode, encode_in_parts, json_response
from companion.server.shared_work import SharedWork
from companion.server.threads import in_file_thread, in_thread
from companion.values import Source
from companion.views import mavlink_messages, series
from companion.views.as_json import Json, as_json
from companion.views.last_messages import Kept, by_sender
from companion.views.state import Node

SystemId = Annotated[int, Path(ge=0, le=255, description="MAVLink system id")]
ComponentId = Annotated[int, Path(ge=0, le=255, description="MAVLink component id")]
RecordingName = Annotated[str, Path(description="name of the file, as in /v1/recordings")]
MessageName = Annotated[str, Path(description="MAVLink name, such as GLOBAL_POSITION_INT")]


def add(app: FastAPI, node: Node, large: LargeAnswers) -> None:
    """Add the routes to the application."""
    _recordings(app, node)
    _playback(app, node)
    _mavlink(app, node, large)


def _recordings(app: FastAPI, node: Node) -> None:
    where, listings = node.pipeline.settings.recording.directory, SharedWork()

    def current() -> recordings.Current:
        status = node.recording()
        return recordings.Current(status.file, status.bytes)

    @app.get(
        "/v1/recordings",
        summary="The recordings: name, size, state and start",
        responses=answers(recordings.Recordings),
    )
    async def listing() -> Response:
        async def read() -> list[Json]:
            return await in_file_thread(recordings.listed, where, current())

        return answer({"recordings": await listings.run("recordings", read)})

    @app.get(
        "/v1/recordings/{name}",
        summary="A recording, or a range of its bytes; an unfinished one up to the last flush",
        response_class=Response,
        responses=file_answers(recordings.MEDIA_TYPE),
    )
    async def download(name: RecordingName, wanted: Range) -> Response:
        found = await in_file_thread(recordings.opened, where, name, current())
        if found is None:
            raise HTTPException(404, f"no recording {name!r}")
        file, size = found
        headers = {"content-disposition": f'attachment; filename="{name}"'}
        return file_answer(
            file, size, wanted=wanted, media_type=recordings.MEDIA_TYPE, headers=headers
        )


def _playback(app: FastAPI, node: Node) -> None:
    where, playback = node.pipeline.settings.recording.directory, Playback()

    @app.get(
        "/v1/recordings/{name}/history",
        summary="Samples of a whole recording, as in /v1/history; 202 while it is being read",
        responses={
            **answers(series.History, 404, 409, 422),
            202: {"model": models.outward(Reading), "description": "Progress; ask again"},
        },
    )
    async def history(name: RecordingName) -> Response:
        version = await in_file_thread(recordings.version, where, name)
        if version is None:
            raise HTTPException(404, f"no recording {name!r}")
        if name == node.recording().file:
            raise HTTPException(409, "this recording is still being written")
        try:
            found = await playback.samples(version)
        except BusyError:
            raise HTTPException(409, "another recording is being read; try again later") from None
        except PlaybackError as error:
            raise HTTPException(409, f"the recording cannot be read: {error}") from error
        if isinstance(found, Reading):
            return answer(as_json(found, node.pipeline.utc_ns), 202)
        return json_response(found)


def _mavlink(app: FastAPI, node: Node, large: LargeAnswers) -> None:
    kept, utc_ns = node.last_messages, node.pipeline.utc_ns

    @app.get(
        "/v1/mavlink/vehicles",
        summary="The last messages of all components, as in mavlink2rest",
        responses=answers(dict[str, mavlink_messages.MavlinkVehicle], 503),
    )
    async def vehicles() -> Response:
        def prepare() -> Make[bytes]:
            found = kept.all()

            def make(way: GivingWay) -> bytes:
                senders = way.between(by_sender(found).items())
                return encode_in_parts(mavlink_messages.vehicles(senders, utc_ns), way, depth=4)

            return make

        return json_response(await large.made("vehicles", prepare))

    @app.get(
        "/v1/mavlink/vehicles/{sys}/components/{comp}/messages",
        summary="The last messages of one component",
        responses=answers(dict[str, mavlink_messages.MavlinkMessage], 404, 422, 503),
    )
    async def messages(sys: SystemId, comp: ComponentId) -> Response:
        def make(found: list[Kept], _way: GivingWay) -> bytes:
            theirs = [one for one in found if one.frame.source == (sys, comp)]
            if not theirs:
                raise HTTPException(404, f"no message received from {sys}:{comp}")
            theirs.sort(key=lambda one: one.frame.msgid)
            return encode(mavlink_messages.messages(theirs, utc_ns))

        what = "messages", sys, comp
        return json_response(await large.made(what, lambda: partial(make, kept.all())))

    @app.get(
        "/v1/mavlink/vehicles/{sys}/components/{comp}/messages/{name}",
        summary="The last message of a kind, as in mavlink2rest",
        responses=answers(mavlink_messages.MavlinkMessage, 404, 422),
    )
    async def message(sys: SystemId, comp: ComponentId, name: MessageName) -> Response:
        dialect = await in_thread(mavlink_messages.dialect)
        msgid = dialect.msgid(name)
        found = None if msgid is None else kept.find(Source(sys, comp), msgid)
        if found is None:
            raise HTTPException(404, f"no {name!r} received from {sys}:{comp}")
        return answer(dialect.message(found, utc_ns))
