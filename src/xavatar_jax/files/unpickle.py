"""Pickles and object arrays from strangers: data is read, code is refused.

Body models, captures and motions are published as pickles, some written with chumpy and Python 2,
some by joblib, some with PyTorch's tensors inside. Reading them with `pickle.load` would run
whatever the file says. Here only NumPy arrays, SciPy sparse matrices, built-in containers and the
arrays inside chumpy's, joblib's and PyTorch's wrappers are built.
"""

from __future__ import annotations

import io
import os
import pickle
import warnings
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy_format

from .inline_arrays import (
    JoblibArray,
    decompress,
    read_torch_storage,
    rebuild_torch_tensor,
    torch_dtype,
)


class UnsafePickleError(ValueError):
    """A pickle asks for something other than plain data."""


class _ChumpyArray:
    """Stands in for `chumpy.ch.Ch` and its relatives: keeps the array, runs nothing of chumpy."""

    def __init__(self, *args: Any) -> None:
        self._state: Any = args[0] if args else None

    def __setstate__(self, state: Any) -> None:
        self._state = state

    def array(self) -> np.ndarray:
        state = self._state
        if isinstance(state, dict) and "x" in state:
            return _plain(state["x"])
        if isinstance(state, dict) and "a" in state and "idxs" in state:
            # chumpy's Select: entries of another array, in another order and shape.
            chosen = np.ravel(_plain(state["a"]))[np.asarray(_plain(state["idxs"]), np.int64)]
            shape = state.get("preferred_shape")
            return chosen if shape is None else chosen.reshape(tuple(shape))
        if isinstance(state, np.ndarray):
            return state
        raise UnsafePickleError(
            "a chumpy object without a stored array: convert the file with chumpy installed, once, "
            "or use the .npz release of the same model"
        )


_NUMPY_MODULES = ("numpy", "numpy.core", "numpy._core")
_BUILTINS = (
    *("dict", "list", "tuple", "set", "frozenset", "str", "bytes", "bytearray", "object"),
    *("int", "float", "complex", "bool", "slice", "range"),
)
_ALLOWED = {("builtins", name) for name in _BUILTINS}
# Python 2's names for the same, and three of its own.
_ALLOWED |= {("__builtin__", name) for name in (*_BUILTINS, "long", "unicode", "xrange")}
_ALLOWED |= {("collections", "OrderedDict"), ("collections", "defaultdict"), ("_codecs", "encode")}
_ALLOWED |= {("copyreg", "_reconstructor"), ("copy_reg", "_reconstructor")}
for _module in _NUMPY_MODULES:
    _ALLOWED |= {
        (_module, "ndarray"),
        (_module, "dtype"),
        (f"{_module}.multiarray", "_reconstruct"),
        (f"{_module}.multiarray", "scalar"),
        (f"{_module}.numeric", "_frombuffer"),
    }
_ALLOWED |= {("numpy.dtypes", name) for name in dir(np.dtypes) if name.endswith("DType")}
_SPARSE = {"csc_matrix", "csr_matrix", "coo_matrix", "csc_array", "csr_array", "coo_array"}


# joblib stores a memory map as the plain array it is, but names its class.
_STANDS_FOR = {("torch", "Size"): tuple, ("numpy", "memmap"): np.ndarray}


class _RestrictedUnpickler(pickle.Unpickler):
    def __init__(self, file: BinaryIO) -> None:
        # latin1 reads the byte strings of arrays that Python 2 pickled.
        super().__init__(file, encoding="latin1")
        self._file = file

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _ALLOWED:
            return super().find_class(module.replace("numpy.core", "numpy._core"), name)
        if (module, name) in _STANDS_FOR:
            return _STANDS_FOR[module, name]
        if (module, name) == ("joblib.numpy_pickle", "NumpyArrayWrapper"):
            # The file must have no `peek`: then the unpickler reads no byte ahead of its opcodes.
            members = {"file": self._file, "unpickle": staticmethod(_unpickle)}
            return type("JoblibArray", (JoblibArray,), members)
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return rebuild_torch_tensor
        if (module, name) == ("torch.storage", "_load_from_bytes"):
            return _torch_storage
        if module.startswith("scipy.sparse") and name in _SPARSE:
            return super().find_class("scipy.sparse", name)
        if module.split(".")[0] == "chumpy" and name in ("Ch", "Select", "MatVecMult", "Add"):
            return _ChumpyArray
        raise UnsafePickleError(
            f"the pickle asks for {module}.{name}, which is not plain data, so it was not read. "
            "Only NumPy arrays, SciPy sparse matrices and built-in containers are accepted."
        )


class _StorageUnpickler(_RestrictedUnpickler):
    """For the pickles inside a PyTorch storage, which name its element type by a class."""

    def find_class(self, module: str, name: str) -> Any:
        dtype = torch_dtype(name) if module == "torch" else None
        return super().find_class(module, name) if dtype is None else dtype

    def persistent_load(self, pid: Any) -> Any:
        return pid


def _torch_storage(data: bytes) -> np.ndarray:
    return read_torch_storage(io.BytesIO(data), lambda file: _StorageUnpickler(file).load())


def _plain(value: Any) -> Any:
    """Containers with chumpy's wrappers replaced by the arrays inside."""
    if isinstance(value, _ChumpyArray):
        return value.array()
    if isinstance(value, JoblibArray):
        return _plain(value.array)
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(_plain(item) for item in value)
    return value


def _unpickle(file: BinaryIO) -> Any:
    with warnings.catch_warnings():
        # Every array that an older NumPy pickled carries its flag as a number: no news to a user.
        warnings.filterwarnings("ignore", message=r"dtype\(\): align should be passed")
        return _plain(_RestrictedUnpickler(file).load())


def load_pickle(path: str | os.PathLike[str]) -> Any:
    """Read a pickle of plain data; arrays of chumpy, joblib and PyTorch come back as NumPy arrays.

    Files that joblib compressed (zlib, gzip, bz2, lzma, xz) are read as well.

    **Raises:** `UnsafePickleError` if the file asks for anything but data, `ValueError` naming the
    file if it is damaged, `FileNotFoundError`.
    """
    try:
        return _unpickle(io.BytesIO(decompress(Path(path).read_bytes())))
    except UnsafePickleError as error:
        raise UnsafePickleError(f"{os.fspath(path)}: {error}") from None
    except OSError:
        raise
    except Exception as error:  # a damaged stream can make the unpickler raise anything
        raise ValueError(f"{os.fspath(path)}: not a readable pickle ({error})") from error


def _read_npy(file: BinaryIO) -> Any:
    version = npy_format.read_magic(file)
    # Read the header once to learn whether the payload is a pickle, then hand over.
    if version == (1, 0):
        shape, fortran, dtype = npy_format.read_array_header_1_0(file)
    elif version == (2, 0):
        shape, fortran, dtype = npy_format.read_array_header_2_0(file)
    else:
        raise ValueError(f"npy format version {version} is not supported")
    if dtype.hasobject:
        return _unpickle(file)
    count = int(np.prod(shape, dtype=np.int64))
    data = np.frombuffer(file.read(count * dtype.itemsize), dtype=dtype, count=count)
    return data.reshape(shape[::-1]).T.copy() if fortran else data.reshape(shape).copy()


def load_npz(path: str | os.PathLike[str], only: str | None = None) -> dict[str, Any]:
    """Read every array of an `.npz`, or `only` one; object arrays are unpickled under restriction.

    A zero-dimensional object array comes back as the object inside (a dict, most often).

    **Raises:** `UnsafePickleError`, `ValueError` naming file and entry, `FileNotFoundError`.
    """
    entries: dict[str, Any] = {}
    name = ""
    try:
        with zipfile.ZipFile(Path(path)) as archive:
            for name in archive.namelist():
                if only not in (None, name.removesuffix(".npy")):
                    continue
                data = _read_npy(io.BytesIO(archive.read(name)))
                if isinstance(data, np.ndarray) and data.dtype.hasobject and data.shape == ():
                    data = _plain(data.item())
                entries[name.removesuffix(".npy")] = data
    except UnsafePickleError as error:
        raise UnsafePickleError(f"{os.fspath(path)}, entry {name!r}: {error}") from None
    except OSError:
        raise
    except Exception as error:  # a damaged archive or stream raises anything
        raise ValueError(
            f"{os.fspath(path)}: not a readable .npz archive (entry {name!r}: {error})"
        ) from error
    return entries
