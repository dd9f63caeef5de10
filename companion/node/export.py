"""Export: logs through the same pipeline as a replay, written as tables."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import companion
from companion.node.replay import Progress, Run, log_events, log_notes
from companion.recording.folders import make_folder
from companion.recording.reader import utc_offset_ns
from companion.recording.scene import Scene
from companion.recording.space_file import SpaceFile
from companion.recording.tables.folder import TableFolder
from companion.settings.model import Settings
from companion.values import Update
from companion.views.tables.said import TABLES, rows

SPACE: Final = "space.mcap"  # the file of an export for Rerun


def export(
    logs: Sequence[Path],
    settings: Settings,
    where: Path,
    *,
    form: str,
    progress: Progress,
    latency_s: float = 0.0,
) -> dict[str, Any]:
    """Write the tables of some logs to a folder; return the summary of a replay, and the files.

        logs       as for ``replay``, and so are ``settings``, ``progress`` and ``latency_s``
        where      the folder; created if missing
        form       a key of ``companion.recording.tables.folder.FORMATS``

    Existing tables are replaced only after all are written. Raises ``LogError`` for an unusable
    log, ``UserError`` if a package is missing, ``OSError`` if the folder cannot be written.
    """
    events = log_events(logs, settings, latency_s)
    run, offset_ns = Run(settings, None), utc_offset_ns(logs)
    with TableFolder(where, form, TABLES) as folder:
        for event, outputs in run.steps(events, progress):
            for table, item in rows(event, outputs, run.pipeline.local):
                folder.add(table, item, offset_ns)
        summary = run.finish() | log_notes(logs)
        del summary["recording"]
        summary["rows"] = dict(folder.rows)
        said = {"companion": companion.__version__, "from": [log.name for log in logs]}
        files = folder.close(said | {"summary": summary, "settings": settings.to_toml()})
    return summary | {"files": [str(file) for file in files]}


def export_space(
    logs: Sequence[Path],
    settings: Settings,
    where: Path,
    progress: Progress,
    latency_s: float = 0.0,
) -> dict[str, Any]:
    """Write tracks and beams in 3D to a file in a folder, for Rerun; return a summary.

    Arguments and errors as for ``export``; the file gets its final name when it is complete.
    """
    events = log_events(logs, settings, latency_s)
    run = Run(settings, None)
    make_folder(where, "--out")
    whole = where / SPACE
    scene = Scene(run.pipeline.array, settings.recording.scene_hz)
    with SpaceFile(whole, scene) as file:
        for _, outputs in run.steps(events, progress):
            for output in outputs:
                if isinstance(output, Update):
                    file.add(output, run.pipeline.local)
    summary = run.finish() | log_notes(logs)
    del summary["recording"]
    return summary | {"rows": {"clouds": file.clouds}, "files": [str(whole)]}
