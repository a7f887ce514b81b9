"""Bounds on what a file may unpack to, and decompression within them."""

from __future__ import annotations

import bz2
import lzma
import os
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol


@dataclass(frozen=True)
class Limits:
    """How much memory the contents of one file may take.

    Attributes:
        total: bytes, whatever the size of the file.
        ratio: multiple of the file's size.
        free: bytes that are allowed whatever the ratio.
        depth: how deeply lists, dictionaries and tuples may be nested.
    """

    total: int = 4 << 30
    ratio: float = 100.0
    free: int = 256 << 20
    depth: int = 64

    def allowed(self, file_size: int) -> int:
        """Bytes that a file of this size may unpack to."""
        return int(min(self.total, max(self.free, self.ratio * file_size)))


DEFAULT_LIMITS = Limits()


class TooLargeError(ValueError):
    """A file unpacks to more than its limits allow."""


class Budget:
    """Bytes that may still be unpacked from one file."""

    def __init__(self, limits: Limits, file_size: int):
        self.limits = limits
        self.allowed = limits.allowed(file_size)
        self.left = self.allowed
        if file_size > limits.total:
            raise TooLargeError(f"{file_size} bytes; the limit is {limits.total} bytes")

    def spend(self, size: int) -> None:
        """Take `size` bytes. **Raises:** `TooLargeError` if fewer are left."""
        self.left -= size
        if self.left < 0:
            raise TooLargeError(
                f"it unpacks to more than {self.allowed} bytes, the limit for a file of its size"
            )


class _Decompressor(Protocol):
    # Read-only, since the standard library's have read-only attributes or properties.
    @property
    def eof(self) -> bool: ...
    @property
    def unused_data(self) -> bytes: ...
    def decompress(self, data: bytes, max_length: int = ..., /) -> bytes: ...


_CHUNK = 1 << 24
_LZMA_MEMORY = 256 << 20  # its dictionary is allocated before anything is unpacked


def read_bytes(path: str | os.PathLike[str], limits: Limits) -> bytes:
    """The bytes of a file. **Raises:** `TooLargeError` if there are more than `limits.total`."""
    with open(Path(path), "rb") as file:
        size = os.fstat(file.fileno()).st_size
        Budget(limits, size)
        return file.read()


def decompress(data: bytes, budget: Budget) -> bytes:
    """Undo the compressions that joblib uses: zlib, gzip, bz2, lzma and xz.

    Other bytes are returned unchanged.

    **Raises:** `ValueError` for damaged data or an unsupported compression, `TooLargeError`.
    """
    head = data[:6]
    if head[:2] == b"\x1f\x8b":
        make: Any = lambda: zlib.decompressobj(31)  # noqa: E731
    elif head[:3] == b"BZh":
        make = bz2.BZ2Decompressor
    elif head[:6] == b"\xfd7zXZ\x00" or head[:3] == b"\x5d\x00\x00":
        make = lambda: lzma.LZMADecompressor(memlimit=_LZMA_MEMORY)  # noqa: E731
    elif head[:1] == b"\x78" and int.from_bytes(head[:2], "big") % 31 == 0:
        make = zlib.decompressobj
    elif head[:4] == b'\x04"M\x18' or head[:2] == b"ZF":
        name = "lz4" if head[:1] == b"\x04" else "a joblib older than 0.10"
        raise ValueError(
            f"compressed by {name}, which is not supported: load it with joblib and dump it again "
            "with compress='zlib'"
        )
    else:
        return data
    try:
        return _unpack(data, make, budget)
    except (OSError, EOFError, lzma.LZMAError, zlib.error) as error:
        raise ValueError(f"damaged compressed data: {error}") from None


def _unpack(data: bytes, make: Any, budget: Budget) -> bytes:
    parts = []
    while data:  # gzip, bz2 and xz files may hold several streams, one after another
        stream: _Decompressor = make()
        while not stream.eof:
            part = stream.decompress(data, _CHUNK)
            budget.spend(len(part))
            parts.append(part)
            # zlib hands back what it has not read; bz2 and lzma keep it.
            data = getattr(stream, "unconsumed_tail", b"")
            if not part and not data and not stream.eof:
                raise EOFError("it ends early")
        data = stream.unused_data.lstrip(b"\0")
    return b"".join(parts)
