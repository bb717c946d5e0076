"""SHA-256 of the content of files and folders."""

from __future__ import annotations

import hashlib
from pathlib import Path

from amiwarp.io.inputs import errors_name, open_input


def content_digest(path: Path, *, noted: bool = True) -> str:
    """Return the SHA-256 of a file, or of the names and contents of the files in a folder.

    ``noted`` is False for a recording of the data set, which may be replaced.
    """
    with errors_name(path, lambda: "cannot be read"):
        if path.is_dir():
            total = hashlib.sha256()
            for file in sorted(inner for inner in path.iterdir() if inner.is_file()):
                total.update(f"{file.name}\0{content_digest(file)}\n".encode())
            return total.hexdigest()
        with open_input(path, noted=noted) as opened:
            return hashlib.file_digest(opened, "sha256").hexdigest()
