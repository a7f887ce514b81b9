"""Arrays that joblib and PyTorch put into pickles in ways of their own, read without either.

joblib writes a small record in the place of an array and the array's bytes behind it, inside the
pickle's stream. PyTorch writes a call that rebuilds a tensor from a storage, which is itself a
sequence of pickles with the numbers behind them.
"""

from __future__ import annotations

import bz2
import gzip
import lzma
import zlib
from collections.abc import Callable
from typing import Any, BinaryIO

import numpy as np

# Element types of PyTorch's storages that NumPy has too; bfloat16 it has not.
_STORAGES = {
    "FloatStorage": "<f4", "DoubleStorage": "<f8", "HalfStorage": "<f2", "LongStorage": "<i8",
    "IntStorage": "<i4", "ShortStorage": "<i2", "CharStorage": "i1", "ByteStorage": "u1",
    "BoolStorage": "?",
}  # fmt: skip
_TORCH_MAGIC = 0x1950A86A20F9469CFC6C


def decompress(data: bytes) -> bytes:
    """What joblib compressed with zlib, gzip, bz2, lzma or xz; other bytes as they are.

    Raises:
        ValueError: damaged data, or a compression that is not read here.
    """
    head = data[:6]
    unpack = None
    if head[:2] == b"\x1f\x8b":
        unpack = gzip.decompress
    elif head[:3] == b"BZh":
        unpack = bz2.decompress
    elif head[:6] == b"\xfd7zXZ\x00" or head[:3] == b"\x5d\x00\x00":
        unpack = lzma.decompress
    elif head[:1] == b"\x78" and int.from_bytes(head[:2], "big") % 31 == 0:
        unpack = zlib.decompress
    elif head[:4] == b'\x04"M\x18' or head[:2] == b"ZF":
        name = "lz4" if head[:1] == b"\x04" else "a joblib older than 0.10"
        raise ValueError(
            f"compressed by {name}, which is not read here: load it with joblib and dump it again "
            "with compress='zlib'"
        )
    if unpack is None:
        return data
    try:
        return unpack(data)
    except (OSError, EOFError, lzma.LZMAError, zlib.error) as error:
        raise ValueError(f"damaged compressed data: {error}") from None


class JoblibArray:
    """Stands in for joblib's `NumpyArrayWrapper`: reads the array that follows in the stream.

    A subclass is made for every stream, with `file` and `unpickle` set. The array is read while
    the record's state is set, since that is where the stream stands at the array's first byte.
    """

    file: BinaryIO
    unpickle: Callable[[BinaryIO], Any]
    array: np.ndarray

    def __setstate__(self, state: dict[str, Any]) -> None:
        dtype, shape = state["dtype"], tuple(int(size) for size in state["shape"])
        if isinstance(dtype, np.dtype) and dtype.kind == "O":
            self.array = type(self).unpickle(self.file)
            return
        if not isinstance(dtype, np.dtype) or dtype.kind not in "biufcSUMm" or min((0, *shape)) < 0:
            raise ValueError(f"an array of type {dtype!r} and shape {shape}")
        # By its name: a pickled type also says of itself whether it holds objects, and may lie.
        dtype = np.dtype(dtype.str)
        if state.get("numpy_array_alignment_bytes") is not None:
            self.file.read(self.file.read(1)[0])
        count = int(np.prod(shape, dtype=np.int64))
        flat = np.frombuffer(_read(self.file, count * dtype.itemsize), dtype, count).copy()
        self.array = flat.reshape(shape[::-1]).T if state["order"] == "F" else flat.reshape(shape)


def torch_dtype(name: str) -> np.dtype | None:
    """Element type of a PyTorch storage class, None where there is no such type in NumPy."""
    return np.dtype(_STORAGES[name]) if name in _STORAGES else None


def read_torch_storage(file: BinaryIO, unpickle: Callable[[BinaryIO], Any]) -> np.ndarray:
    """The numbers of one storage, in the layout of `torch.save` before its zip files.

    Args:
        file: five pickles (a magic number, a version, facts of the machine, the storage's
            element type and size, its key), the number of elements, and the elements.
        unpickle: reads one pickle, with the storage's class as its `np.dtype` and its persistent
            id as the tuple that stands in the file.
    """
    if unpickle(file) != _TORCH_MAGIC:
        raise ValueError("a tensor that is not in PyTorch's storage format")
    _version, machine, storage, _keys = (unpickle(file) for _ in range(4))
    if not machine.get("little_endian", True):
        raise ValueError("a tensor with big-endian numbers")
    dtype = storage[1]
    count = int.from_bytes(_read(file, 8), "little")
    return np.frombuffer(_read(file, count * dtype.itemsize), dtype, count)


def rebuild_torch_tensor(
    storage: np.ndarray, offset: int, size: tuple[int, ...], stride: tuple[int, ...], *_: Any
) -> np.ndarray:
    """The array that a tensor shows of its storage; offset and stride count elements."""
    if not isinstance(storage, np.ndarray) or storage.dtype.kind not in "biuf":
        raise ValueError("a tensor without a storage of numbers")
    numbers = np.ascontiguousarray(storage).reshape(-1)
    offset, size = int(offset), tuple(int(n) for n in size)
    stride = tuple(int(step) for step in stride)
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if min((offset, *size, *stride)) < 0 or (0 not in size and last >= numbers.size):
        raise ValueError(f"a tensor of shape {size} that reaches outside its storage")
    if 0 in size:
        return np.zeros(size, numbers.dtype)
    steps = tuple(step * numbers.itemsize for step in stride)
    return np.lib.stride_tricks.as_strided(numbers[offset:], size, steps).copy()


def _read(file: BinaryIO, size: int) -> bytes:
    data = file.read(size)
    if len(data) != size:
        raise ValueError(f"the file ends inside an array: {len(data)} of {size} bytes are there")
    return data
