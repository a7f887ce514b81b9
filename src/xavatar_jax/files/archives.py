"""Archives of arrays: NumPy's `.npz` and `.npy`, PyTorch's zip files, and JSON, all as data."""

from __future__ import annotations

import io
import json
import os
import re
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from .limits import DEFAULT_LIMITS, Budget, Limits, TooLargeError, read_bytes
from .pickles import UnsafePickleError, element_type, from_bytes, torch_dtype, unpickle

_HEADER = re.compile(
    r"\s*\{\s*'descr':\s*'([^']{1,40})',\s*'fortran_order':\s*(True|False),"
    r"\s*'shape':\s*\(([\d\sL,]{0,400})\),?\s*\}\s*"
)


def load_npz(
    path: str | os.PathLike[str], only: str | None = None, *, limits: Limits = DEFAULT_LIMITS
) -> dict[str, Any]:
    """Read every array of an `.npz`, or `only` one. Object arrays are read by `unpickle`.

    A zero-dimensional object array comes back as the object inside (a dict, most often).

    **Raises:** `UnsafePickleError`, `ValueError` naming file and entry, `FileNotFoundError`.
    """
    entries: dict[str, Any] = {}
    entry = ""
    with open(Path(path), "rb") as file:
        try:
            archive, budget = _open_zip(file, limits)
            for info in archive.infolist():
                entry = info.filename
                name = entry.removesuffix(".npy")
                if only in (None, name):
                    entries[name] = _read_npy(io.BytesIO(archive.read(info)), budget)
        except Exception as error:  # a damaged archive or entry can fail anywhere
            where = f"entry {entry!r}: " if entry else ""
            raise _explained(path, "a readable .npz archive", error, where) from error
    return entries


def load_npy(path: str | os.PathLike[str], *, limits: Limits = DEFAULT_LIMITS) -> Any:
    """Read a `.npy` array; a zero-dimensional object array comes back as the object inside.

    **Raises:** as `load_npz`.
    """
    data = read_bytes(path, limits)
    try:
        return _read_npy(io.BytesIO(data), Budget(limits, len(data)))
    except Exception as error:
        raise _explained(path, "a readable .npy array", error) from error


def is_torch(path: str | os.PathLike[str]) -> bool:
    """Whether a zip file was written by PyTorch. Damaged files were not."""
    try:
        with zipfile.ZipFile(path) as archive:
            return _torch_root(archive) is not None
    except Exception:
        return False


def load_torch(path: str | os.PathLike[str], *, limits: Limits = DEFAULT_LIMITS) -> Any:
    """Read a zip file of `torch.save` without PyTorch; tensors become NumPy arrays.

    **Raises:** as `load_npz`.
    """
    with open(Path(path), "rb") as file:
        try:
            archive, budget = _open_zip(file, limits)
            root = _torch_root(archive)
            if root is None:
                raise ValueError("it has no data.pkl")
            if f"{root}byteorder" in archive.namelist():
                order = archive.read(f"{root}byteorder")
                if order.strip() != b"little":
                    raise ValueError("tensors with big-endian numbers")
            storages: dict[str, np.ndarray] = {}

            def storage(identifier: Any) -> np.ndarray:
                # A tuple of "storage", element type, key, device and number of elements.
                kind, name, key, _device, count = identifier
                if kind != "storage" or not isinstance(key, str):
                    raise UnsafePickleError(f"the pickle refers to data of kind {str(kind)[:40]}")
                if key not in storages:
                    data = archive.read(f"{root}data/{key}")
                    dtype = torch_dtype(name)
                    storages[key] = from_bytes(data, dtype, (count,), False, budget)
                return storages[key]

            data = io.BytesIO(archive.read(f"{root}data.pkl"))
            return unpickle(data, budget, storage)
        except Exception as error:
            raise _explained(path, "a readable PyTorch file", error) from error


def load_json(path: str | os.PathLike[str], *, limits: Limits = DEFAULT_LIMITS) -> Any:
    """Read a JSON document, with numbers beyond the range of floats as infinity.

    **Raises:** `ValueError` naming the file if it is no JSON or nested too deeply,
    `FileNotFoundError`.
    """
    return parse_json(read_bytes(path, limits), os.fspath(path), limits=limits)


def parse_json(data: bytes, where: str, *, limits: Limits = DEFAULT_LIMITS) -> Any:
    """The value of a JSON document. **Raises:** `ValueError` naming `where`."""
    try:
        text = data.decode("utf-8-sig")
        value = json.loads(text, parse_int=_whole_number)
    except RecursionError:
        raise ValueError(f"{where}: not readable JSON (nested too deeply).") from None
    except ValueError as error:
        raise ValueError(f"{where}: not readable JSON ({error}).") from None
    layer, depth = [value], 0
    while layer:
        if depth > limits.depth:
            raise ValueError(f"{where}: JSON nested more than {limits.depth} deep.")
        layer = [
            entry
            for holder in layer
            if isinstance(holder, (dict, list))
            for entry in (holder.values() if isinstance(holder, dict) else holder)
            if isinstance(entry, (dict, list))
        ]
        depth += 1
    return value


def _whole_number(text: str) -> int | float:
    return int(text) if len(text) < 19 else float(text)


def _open_zip(file: BinaryIO, limits: Limits) -> tuple[zipfile.ZipFile, Budget]:
    size = os.fstat(file.fileno()).st_size
    budget = Budget(limits, size)
    archive = zipfile.ZipFile(file)
    whole = sum(info.file_size for info in archive.infolist())
    if whole > budget.allowed:
        raise TooLargeError(
            f"its entries take {whole} bytes unpacked, {whole / size:.0f} times the size of the "
            f"file; the limit is {budget.allowed} bytes"
        )
    for info in archive.infolist():
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError(f"entry {info.filename!r} is compressed in a way NumPy never uses")
    return archive, budget


def _torch_root(archive: zipfile.ZipFile) -> str | None:
    """The folder inside a PyTorch file, with its slash; None for other archives."""
    for name in archive.namelist():
        if name == "data.pkl" or name.endswith("/data.pkl"):
            return name.removesuffix("data.pkl")
    return None


def _read_npy(file: BinaryIO, budget: Budget) -> Any:
    magic = file.read(8)
    if magic[:6] != b"\x93NUMPY":
        raise ValueError("it does not begin as a NumPy array does")
    version = tuple(magic[6:])
    if version not in ((1, 0), (2, 0), (3, 0)):
        raise ValueError(f"npy format version {version} is not supported")
    size = int.from_bytes(file.read(2 if version == (1, 0) else 4), "little")
    text = file.read(min(size, 10_000)).decode("latin-1")
    found = _HEADER.fullmatch(text)
    if found is None:
        several = "'descr': [" in text or '"descr": [' in text
        reason = "an array of several fields; only plain numbers are read" if several else (
            f"a header that is not understood: {text.strip()[:80]!r}"
        )  # fmt: skip
        raise ValueError(reason)
    descr, fortran, sizes = found.groups()
    shape = tuple(int(n.strip().rstrip("L")) for n in sizes.split(",") if n.strip())
    dtype = element_type(descr)
    if dtype.kind != "O":
        return from_bytes(file.read(), dtype, shape, fortran == "True", budget)
    value = unpickle(file, budget)
    if isinstance(value, np.ndarray) and value.dtype.kind == "O" and value.shape == ():
        return value.item()
    return value


def _explained(
    path: str | os.PathLike[str], expected: str, error: Exception, where: str = ""
) -> ValueError:
    """The error that names the file, of whatever reading it raised."""
    name = os.fspath(path)
    if isinstance(error, UnsafePickleError):
        return UnsafePickleError(
            f"{name}, {where.removesuffix(': ')}: {error}" if where else f"{name}: {error}"
        )
    if isinstance(error, TooLargeError):
        return TooLargeError(f"{name}: {where}{error}")
    said = str(error) or type(error).__name__
    return ValueError(f"{name}: not {expected} ({where}{said})")
