"""A recorded session on disk: open it, check it, write it.

::

    session.json            schema, name, licence, board, rig, placements; units are part of the key names
    lrf/scans.npz           ranges (N, B), bearings (B,), placement (N,), pitch (N,), time_s (N,) [, intensities (N, B)]
    lrf/telegrams.bin       or what the device sent, and lrf/index.csv: t_s, offset, length, placement, pitch_deg
    images/<camera>/*.png   images.csv: t_s, camera, file, placement, pitch_deg, purpose (intrinsics | board | scene)
    edges.csv               optional edges picked by hand: camera, file, edge, u1, v1, u2, v2
    platform.csv            recordings only, never read here: t_s, commanded_deg, measured_deg
    truth.json              simulated sessions only; never read here
    writer.lock             only while it is written: who does that; one at a time

Everything is plain text or a NumPy archive without pickles, in plain files: links are refused, and so is what would
take more than 500 MB of memory (more than 12 million ranges, images of more than 30 megapixels, longer tables than
200 000 lines). session.json may name the LRF's file (rig.lrf.file), otherwise the one that exists is read. A row of
scans.npz is one scan line in the order of acquisition; a range is NaN where nothing came back or nothing was recorded.
"""

from __future__ import annotations

from lrfcal_lib.session.files import EDGE_COLUMNS, IMAGE_COLUMNS, PURPOSES, EdgePick, ImageRecord, image_size
from lrfcal_lib.session.opened import SessionError
from lrfcal_lib.session.recorder import SessionRecorder
from lrfcal_lib.session.recording import Session, Sweep, open_session, validate
from lrfcal_lib.session.stated import (
    SCHEMA,
    CameraInfo,
    LrfInfo,
    board_from_json,
    board_to_json,
    model_from_json,
    model_to_json,
    transform_from_json,
    transform_to_json,
)
from lrfcal_lib.session.telegrams import INDEX_COLUMNS, TelegramLog
from lrfcal_lib.session.writer import SessionWriter, finish

__all__ = [
    "EDGE_COLUMNS", "IMAGE_COLUMNS", "INDEX_COLUMNS", "PURPOSES", "SCHEMA", "CameraInfo", "EdgePick", "ImageRecord",
    "LrfInfo", "Session", "SessionError", "SessionRecorder", "SessionWriter", "Sweep", "TelegramLog", "board_from_json",
    "board_to_json", "finish", "image_size", "model_from_json", "model_to_json", "open_session", "transform_from_json",
    "transform_to_json", "validate",
]  # fmt: skip
