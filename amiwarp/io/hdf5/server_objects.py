"""Groups, datasets and attributes of an open HDF5 file. Runs in the reading process."""

from collections.abc import Sequence
from typing import Any

import h5py  # noqa: TID253 - only the reading process imports this module
import hdf5plugin  # noqa: F401, TID253 - its import registers the filters
import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.native.layout import ATTRIBUTE_BYTES


def all_values(stored: Any) -> NDArray[Any]:
    """Return all values of a dataset or an attribute."""
    values = np.zeros(stored.shape, stored.dtype)
    if isinstance(stored, h5py.h5d.DatasetID):
        stored.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
    else:
        stored.read(values)
    return values


class Finder:
    """Groups and datasets of an open file, each of which is opened once. All access to its objects goes through it.

    Raises :class:`AmiwarpError` for links, and for datasets whose values are in other files. It uses h5py's
    low-level objects, which take less time.
    """

    def __init__(self, file: Any) -> None:
        self._found: dict[str, Any] = {"": h5py.h5g.open(file, b"/")}

    def find(self, name: str) -> Any:
        """Return the object of that name, or None."""
        if name not in self._found:
            self._found[name] = self._open(name)
        return self._found[name]

    def _open(self, name: str) -> Any:
        folder, _, last = name.rpartition("/")
        parent = self.find(folder)
        key = last.encode()
        if not isinstance(parent, h5py.h5g.GroupID) or not parent.links.exists(key):
            return None
        if parent.links.get_info(key).type != h5py.h5l.TYPE_HARD:
            raise AmiwarpError(
                f"'{name}' is a soft or external link; replace the link by a copy of the data",
                ErrorCode.FORMAT_UNKNOWN,
            )
        found = h5py.h5o.open(parent, key)
        if isinstance(found, h5py.h5d.DatasetID):
            creation = found.get_create_plist()
            if creation.get_layout() == h5py.h5d.VIRTUAL or creation.get_external_count():
                raise AmiwarpError(
                    f"dataset '{name}' takes its values from other files; copy the values into this file",
                    ErrorCode.FORMAT_UNKNOWN,
                )
        return found


def member(file: h5py.File, name: str) -> Any:
    """Return a group or dataset of the file, or None, as :class:`Finder`."""
    opened = Finder(file.id).find(name)
    if isinstance(opened, h5py.h5d.DatasetID):
        return h5py.Dataset(opened)
    if isinstance(opened, h5py.h5g.GroupID):
        return h5py.Group(opened)
    return None


def group_of(objects: Finder, name: str) -> Any:
    """Return the group of that name, or None. Raises :class:`AmiwarpError` for a dataset."""
    item = objects.find(name.strip("/"))
    if item is not None and not isinstance(item, h5py.h5g.GroupID):
        raise AmiwarpError(
            f"'{name}' is a dataset; expected a group (docs/reference/recording-format.md)",
            ErrorCode.FORMAT_UNKNOWN,
        )
    return item


def attributes_of(group: Any, name: str, wanted: Sequence[str] | None) -> dict[str, Any]:
    """Return the ``wanted`` attributes of a group that exist; all if that is None.

    ``name``: name of the group, for messages.
    """
    if wanted is None:
        wanted = [_text(stored_name) for stored_name in h5py.Group(group).attrs]
    return {
        attribute: _value(group, name, attribute)
        for attribute in wanted
        if h5py.h5a.exists(group, attribute.encode())
    }


def _value(group: Any, name: str, attribute: str) -> Any:
    """Return the value of an attribute: a number, a string, or a list of these."""
    stored = h5py.h5a.open(group, attribute.encode())
    classes = (h5py.h5t.INTEGER, h5py.h5t.FLOAT, h5py.h5t.STRING, h5py.h5t.ENUM)
    if stored.get_type().get_class() not in classes or stored.shape is None:
        raise AmiwarpError(
            f"{name} attribute '{attribute}' is neither a number nor a string; remove it",
            ErrorCode.FORMAT_UNKNOWN,
        )
    # A text of variable length counts as 16 bytes here; its own length is checked once it is read.
    stored_bytes = stored.get_storage_size()
    _check_size(stored_bytes, name, attribute)
    value = plain_value(all_values(stored)[()])
    texts = value if isinstance(value, list) else [value]
    text_bytes = sum(len(text.encode()) for text in texts if isinstance(text, str))
    _check_size(text_bytes, name, attribute)
    return value


def _check_size(size_bytes: int, name: str, attribute: str) -> None:
    if size_bytes > ATTRIBUTE_BYTES:
        raise AmiwarpError(
            f"{name} attribute '{attribute}' has {size_bytes:,} bytes, over {ATTRIBUTE_BYTES:,}; remove or shorten it",
            ErrorCode.FILE_DAMAGED,
        )


def plain_value(value: Any) -> Any:
    """Return a value of NumPy or HDF5 as a plain Python value."""
    if isinstance(value, np.ndarray):
        return [plain_value(item) for item in value.ravel()]
    if isinstance(value, (bytes, str)):
        return _text(value)
    if isinstance(value, np.floating):
        return float(value)
    return value.item() if isinstance(value, np.generic) else value


def _text(value: Any) -> str:
    """Decode text as UTF-8; bytes that are not UTF-8 are replaced."""
    stored = value if isinstance(value, bytes) else value.encode("utf-8", "surrogateescape")
    return stored.decode("utf-8", "replace")


def is_dataset(item: Any) -> bool:
    """Return whether a member of a file is a dataset with rows."""
    return isinstance(item, h5py.Dataset) and item.ndim > 0
