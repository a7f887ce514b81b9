"""Names for the contents of a file."""

from __future__ import annotations

import hashlib
import os


def file_checksum(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a file's bytes, as hexadecimal digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
