"""Codes of errors: what each is for, and that errors keep them on their way to the caller."""

import errno
import pickle
import re
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

import amiwarp
from amiwarp import AmiwarpError, Camera, Encoder, ErrorCode, Events, MemoryEvents, Prism, Recording
from amiwarp.cli.common import choose_device
from amiwarp.errors import optional_module
from amiwarp.io.outputs import NewFile
from amiwarp.live.stream import open_source
from tests import ROOT
from tests.errors import refused

COUNT = 500


def recording() -> Recording:
    rng = np.random.default_rng(3)
    x, y, p = (rng.integers(0, high, COUNT) for high in (64, 48, 2))
    events = Events.from_arrays(x, y, np.arange(COUNT) * 100, p)
    camera = Camera.from_fov(64, 48, 1.0)
    encoder = Encoder.from_angles([0, 100 * COUNT], [0.0, 3.0])
    return Recording(MemoryEvents(events, 64, 48), camera, encoder, Prism(0.03))


def text_file(text: str, name: str) -> str:
    Path(name).write_text(text)
    return name


def invalid() -> None:
    Prism(apex=2.0)


def field() -> None:
    amiwarp.load_camera(text_file("camera_matrix: {data: 3}", "a.yaml"))


def options() -> None:
    amiwarp.save_recording("a.h5", recording())
    amiwarp.open_recording("a.h5", columns="t,x,y,p")


def file_missing() -> None:
    amiwarp.open_recording("none.h5")


def file_unreadable() -> None:
    Path("folder.yaml").mkdir()
    amiwarp.load_camera("folder.yaml")


def file_damaged() -> None:
    """HDF5 is read in another process, which sends the code."""
    amiwarp.save_recording("a.h5", recording())
    Path("a.h5").write_bytes(Path("a.h5").read_bytes()[:5000])
    amiwarp.open_recording("a.h5")


def format_unknown() -> None:
    Path("a.bin").write_bytes(bytes(range(256)))
    amiwarp.open_recording("a.bin")


def content_missing() -> None:
    amiwarp.open_recording(text_file("", "a.csv"))


def ambiguous() -> None:
    """It is not known which of the polarities 3 and 7 is ON."""
    rows = "".join(f"{k * 1000},{k},{k},{3 + k % 2 * 4}\n" for k in range(40))
    amiwarp.open_recording(text_file(f"t,x,y,p\n{rows}", "a.csv"))


def output_exists() -> None:
    for _ in range(2):
        amiwarp.save_recording("a.h5", recording())


def output_failed() -> None:
    amiwarp.save_recording("none/a.h5", recording())


def disk_full() -> None:
    with NewFile("a.bin"):
        raise OSError(errno.ENOSPC, "No space left on device")


def device_missing() -> None:
    choose_device("cuda:77")


def package_missing() -> None:
    optional_module("no_such_package", "lens", "boards need OpenCV")


def unreachable() -> None:
    open_source("unix:none.socket")


def calibration_refused() -> None:
    amiwarp.calibrate(recording())


CAUSES: dict[ErrorCode, Callable[[], None]] = {
    ErrorCode.INVALID: invalid,
    ErrorCode.FIELD: field,
    ErrorCode.OPTIONS: options,
    ErrorCode.FILE_MISSING: file_missing,
    ErrorCode.FILE_UNREADABLE: file_unreadable,
    ErrorCode.FILE_DAMAGED: file_damaged,
    ErrorCode.FORMAT_UNKNOWN: format_unknown,
    ErrorCode.CONTENT_MISSING: content_missing,
    ErrorCode.AMBIGUOUS: ambiguous,
    ErrorCode.OUTPUT_EXISTS: output_exists,
    ErrorCode.OUTPUT_FAILED: output_failed,
    ErrorCode.DISK_FULL: disk_full,
    ErrorCode.DEVICE_MISSING: device_missing,
    ErrorCode.PACKAGE_MISSING: package_missing,
    ErrorCode.UNREACHABLE: unreachable,
    ErrorCode.CALIBRATION_REFUSED: calibration_refused,
}


@pytest.mark.parametrize("code", CAUSES)
def test_an_error_has_the_code_of_its_kind(
    code: ErrorCode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(AmiwarpError) as caught:
        CAUSES[code]()
    assert caught.value.code is code, caught.value


def test_every_code_is_tested_and_on_the_page_of_errors() -> None:
    page = (ROOT / "docs" / "reference" / "conventions.md").read_text()
    rows = re.findall(r"^\| `([a-z-]+)` \| \S.* \|$", page.partition("## Errors")[2], re.MULTILINE)
    assert rows == [code.value for code in ErrorCode]
    assert list(CAUSES) == list(ErrorCode)


def picture() -> None:
    Path("a.raw").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(99))
    amiwarp.open_recording("a.raw")


def words_without_rows() -> None:
    amiwarp.open_recording(text_file("x y t p\nno numbers\n", "a.txt"))


def array_of_one_dimension() -> None:
    np.save("a.npy", np.arange(4))
    amiwarp.open_recording("a.npy")


def columns_of_text() -> None:
    amiwarp.save_recording("a.h5", recording())
    with h5py.File("a.h5", "r+") as file:
        del file["events/t"]
        file["events/t"] = np.full(COUNT, 0.5)
    amiwarp.open_recording("a.h5")


def device_of_another_machine() -> None:
    events = recording().events.slice(0, 9)
    amiwarp.iwe(events, 64, 48, device="cuda:77")


@pytest.mark.parametrize(
    ("cause", "code"),
    [
        (picture, ErrorCode.FORMAT_UNKNOWN),
        (words_without_rows, ErrorCode.FORMAT_UNKNOWN),
        (array_of_one_dimension, ErrorCode.FORMAT_UNKNOWN),
        (columns_of_text, ErrorCode.FORMAT_UNKNOWN),
        (device_of_another_machine, ErrorCode.DEVICE_MISSING),
    ],
)
def test_the_same_cause_has_the_same_code_everywhere(
    cause: Callable[[], None],
    code: ErrorCode,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    with refused(code):
        cause()


def raised(message: str, code: ErrorCode | None, cause: Exception | None) -> AmiwarpError:
    with pytest.raises(AmiwarpError) as caught:
        raise AmiwarpError(message, code) from cause
    return caught.value


def test_an_error_that_adds_a_name_keeps_the_code() -> None:
    damaged = raised("the file is damaged", ErrorCode.FILE_DAMAGED, None)
    named = raised("a.h5: the file is damaged", None, damaged)
    assert named.code is ErrorCode.FILE_DAMAGED
    assert raised("in b: a.h5: the file is damaged", None, named).code is ErrorCode.FILE_DAMAGED
    assert raised("out.h5: exists", ErrorCode.OUTPUT_EXISTS, named).code is ErrorCode.OUTPUT_EXISTS
    assert raised("other", None, OSError("full")).code is ErrorCode.INVALID


def test_an_error_from_another_process_keeps_the_code() -> None:
    damaged = raised("the file is damaged", ErrorCode.FILE_DAMAGED, None)
    named = raised("a.h5: the file is damaged", None, damaged)
    sent = pickle.loads(pickle.dumps(named))
    assert (str(sent), sent.code) == ("a.h5: the file is damaged", ErrorCode.FILE_DAMAGED)
