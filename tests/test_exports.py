"""Names of exported files: plain file names in one folder that never replace an existing file."""

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from amiwarp.errors import AmiwarpError
from amiwarp.viewer.exports import export_path

PNG = (".png",)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("../x.png", "holds '/'"),
        ("/etc/x.png", "holds '/'"),
        ("a/b.png", "holds '/'"),
        ("..\\x.png", r"holds '\\\\'"),
        ("C:x.png", "holds ':'"),
        ("..", "ordinary file"),
        (".x.png", "ordinary file"),
        ("~x.png", "ordinary file"),
        ("-x.png", "ordinary file"),
        ("nul.png", "ordinary file"),
        ("x.png.", "ordinary file"),
        ("a\nb.png", r"holds '\\n'"),
        ("a\x00b.png", r"holds '\\x00'"),
        ("a\u202eb.png", r"holds '\\u202e'"),
        ("\ud800.png", "holds"),
        ("x" * 300, "300 characters"),
        ("x.h5", "must end in .png"),
        ("x.json", "must end in .png"),
    ],
    ids=ascii,
)
def test_other_than_plain_names_are_refused(tmp_path: Path, name: str, says: str) -> None:
    with pytest.raises(AmiwarpError, match=says) as error:
        export_path(tmp_path, name, "rec", PNG)
    assert "\n" not in str(error.value)


def test_what_exists_is_refused_also_as_a_link_to_nothing(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"kept")
    os.symlink(tmp_path / "nothing", tmp_path / "b.png")
    for name in ("a.png", "a", "b.png"):
        with pytest.raises(AmiwarpError, match="exists"):
            export_path(tmp_path, name, "rec", PNG)


def test_an_unnamed_export_has_the_recording_s_name_and_a_number_if_need_be(tmp_path: Path) -> None:
    assert export_path(tmp_path, " ", "rec", (".mp4", ".gif")) == tmp_path / "rec.mp4"
    for name in ("rec.mp4", "rec.2.mp4"):
        (tmp_path / name).touch()
    assert export_path(tmp_path, "", "rec", (".mp4", ".gif")) == tmp_path / "rec.3.mp4"
    assert export_path(tmp_path, "", "tcp://10.0.0.1:7/../x\n", PNG) == tmp_path / "tcp_10.0.0.1_7_.._x.png"
    assert export_path(tmp_path, "", "..", PNG) == tmp_path / "recording.png"
    assert export_path(tmp_path, "turn.gif", "rec", (".mp4", ".gif")) == tmp_path / "turn.gif"


@given(name=st.text(max_size=200), stem=st.text(max_size=200))
def test_no_name_leads_out_of_the_folder(name: str, stem: str) -> None:
    folder = Path(__file__).parent
    try:
        path = export_path(folder, name, stem, PNG)
    except AmiwarpError:
        return
    assert path.parent == path.resolve().parent == folder
    assert path.name.endswith(".png") or path.name.lower().endswith(".png")
    assert not path.name.startswith(".")
    assert not os.path.lexists(path)
