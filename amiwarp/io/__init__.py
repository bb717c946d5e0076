"""Readers and writers of recordings.

:func:`open_recording` reads every format. :class:`RecordingWriter` writes the native format.
"""

from amiwarp.io.encoder_files import read_encoder_csv, read_encoder_triggers
from amiwarp.io.export import ConversionSummary, convert
from amiwarp.io.formats import Format, detect_format, open_recording
from amiwarp.io.native_format import RecordingWriter, save_recording

__all__ = [
    "ConversionSummary",
    "Format",
    "RecordingWriter",
    "convert",
    "detect_format",
    "open_recording",
    "read_encoder_csv",
    "read_encoder_triggers",
    "save_recording",
]
