"""Readers and writers of recordings.

:func:`open_recording` reads every format. :class:`RecordingWriter` writes the native format.
"""

import lazy_loader

from amiwarp.io.conversion import ConversionSummary, convert
from amiwarp.io.encoder_csv import read_encoder_csv
from amiwarp.io.encoder_triggers import read_encoder_triggers
from amiwarp.io.formats import Format, detect_format, open_recording
from amiwarp.io.native.copying import save_recording
from amiwarp.io.native.writer import RecordingWriter

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
