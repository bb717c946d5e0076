"""Other platforms, as far as Linux can imitate them: packages that are missing there, and systems without POSIX."""

import sys
from pathlib import Path

import numpy as np
import pytest

from amiwarp import AmiwarpError, convert, open_recording
from amiwarp.io import reading_process
from reference.io_samples import make_events, write_native, write_sample
from tests import test_io_formats
from tests.test_io_readers import assert_equal

EVENTS = make_events()


@pytest.fixture
def no_faery(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide faery from this process, and from the reading process by a module that cannot be imported."""
    (tmp_path / "hidden").mkdir()
    (tmp_path / "hidden" / "faery.py").write_text("raise ImportError", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path / "hidden")
    monkeypatch.setitem(sys.modules, "faery", None)
    monkeypatch.setattr(reading_process, "_idle", [])


@pytest.mark.usefixtures("no_faery")
@pytest.mark.parametrize("version", ["2", "3"])
def test_raw_files_without_faery(tmp_path, version):
    recording = open_recording(write_sample(tmp_path, f"evt{version}", EVENTS))
    assert (recording.metadata["format"], len(recording.events)) == (f"evt{version}.0", len(EVENTS))
    assert_equal(recording.events.slice(0, len(EVENTS)), EVENTS)
    test_io_formats.test_triggers_of_raw_files(tmp_path, version)


@pytest.mark.parametrize("name", ["evt3_driving_1280x720.raw", "evt2_balls_640x480.raw"])
def test_raw_files_of_cameras_without_faery(data_dir, request, name):
    with_faery = open_recording(data_dir / "evt" / name).events
    request.getfixturevalue("no_faery")
    without = open_recording(data_dir / "evt" / name).events
    assert len(without) == len(with_faery)
    expected, found = (events.slice(0, len(with_faery)) for events in (with_faery, without))
    assert all(np.array_equal(getattr(found, column), getattr(expected, column)) for column in "xyp")
    # faery raises a time to the largest in any word before it: by up to 11 us in the file of EVT 3.
    assert 0 <= (expected.t - found.t).max() <= 11


@pytest.mark.usefixtures("no_faery")
@pytest.mark.parametrize("name", ["aedat4", "es"])
def test_files_that_need_faery_name_it(tmp_path, name):
    with pytest.raises(AmiwarpError, match=rf"sample\.{name}: .* need faery, .*'pip install faery', or convert"):
        open_recording(write_sample(tmp_path, name, EVENTS))


@pytest.mark.usefixtures("no_faery")
def test_writing_aedat4_names_faery(tmp_path):
    write_native(tmp_path / "in.h5", EVENTS)
    with pytest.raises(AmiwarpError, match=r"out\.aedat4: .* need faery, "):
        convert(tmp_path / "in.h5", tmp_path / "out.aedat4")
    assert not list(tmp_path.glob("*.aedat4"))
