"""Recordings whose bytes are cut or altered."""

from __future__ import annotations

from pathlib import Path

from bodyseg_data.core import BadConfig
from bodyseg_model.recordings.frames import open_recording


def reads_or_refuses(path: Path, data: bytes) -> bool:
    """True where a file with these bytes is refused; errors are one line."""
    path.write_bytes(data)
    refused = False
    try:
        for frame in open_recording(path):
            try:
                frame.read()
            except BadConfig as error:
                assert "\n" not in str(error)
    except BadConfig as error:
        assert "\n" not in str(error)
        refused = True
    return refused
