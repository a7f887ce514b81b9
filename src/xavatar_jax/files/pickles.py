"""Pickles of unknown origin, read as data.

Body models, captures and motions are published as pickles, some written with chumpy and Python 2,
some by joblib or PyTorch. `pickle.load` would run whatever such a file says. The interpreter here
imports nothing and calls nothing that a file names: names stay inert, and the few calls that make
up arrays (NumPy's, SciPy's, chumpy's, joblib's, PyTorch's) are recognised and carried out by code
of ours, on checked arguments.
"""

from __future__ import annotations

import codecs
import io
import os
import pickletools
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, BinaryIO

import numpy as np

from .limits import DEFAULT_LIMITS, Budget, Limits, TooLargeError, decompress, read_bytes


class UnsafePickleError(ValueError):
    """A pickle asks for something other than plain data."""


def load_pickle(path: str | os.PathLike[str], *, limits: Limits = DEFAULT_LIMITS) -> Any:
    """Read a pickle of plain data; arrays of chumpy, joblib and PyTorch become NumPy arrays.

    Files that joblib compressed (zlib, gzip, bz2, lzma, xz) are read as well. Subclasses of
    `dict`, such as `OrderedDict`, become `dict`.

    **Raises:** `UnsafePickleError` if the file asks for anything but data, `ValueError` naming the
    file if it is damaged or unpacks to more than `limits`, `FileNotFoundError`.
    """
    name = os.fspath(path)
    try:
        data = read_bytes(path, limits)
        budget = Budget(limits, len(data))
        return unpickle(io.BytesIO(decompress(data, budget)), budget)
    except UnsafePickleError as error:
        raise UnsafePickleError(f"{name}: {error}") from None
    except OSError:
        raise
    except TooLargeError as error:
        raise TooLargeError(f"{name}: {error}") from None
    except (Exception, RecursionError) as error:  # damaged bytes can fail anywhere
        raise ValueError(
            f"{name}: not a readable pickle ({error or type(error).__name__})"
        ) from error


def unpickle(
    file: BinaryIO, budget: Budget, storage: Callable[[Any], np.ndarray] | None = None
) -> Any:
    """Read one pickle from a seekable stream, which is left behind its last byte.

    Args:
        file: must have the whole file in memory, so that a length beyond its end is harmless.
        budget: bytes that may be unpacked.
        storage: the array that a persistent identifier names; None refuses them.

    Raises:
        UnsafePickleError: the pickle asks for anything but data.
        Exception: of any kind, if the stream is damaged.
    """
    return _Resolver(budget).resolve(_Machine(file, budget, storage).run())


@dataclass(frozen=True)
class Name:
    """A name in a pickle: of a class or function, never looked up."""

    module: str
    name: str

    def __str__(self) -> str:
        return f"{self.module}.{self.name}"[:120]


@dataclass(eq=False)
class _Object:
    """An instance under construction: what it is of, its arguments, and its value once known."""

    name: Name
    args: tuple[Any, ...]
    value: Any = None
    known: bool = False
    state: Any = field(default=None, repr=False)


def _refuse(name: Name) -> UnsafePickleError:
    return UnsafePickleError(
        f"the pickle asks for {name}, which is not plain data, so it was not read. Only NumPy "
        "arrays, SciPy sparse matrices and built-in containers are accepted."
    )


# Names of older Python and NumPy versions.
_MODULES = {"__builtin__": "builtins", "copy_reg": "copyreg"}
_OP_COST, _CONTAINER_COST = 48, 200  # bytes: about what an object takes
_MARK = object()
_FLOAT = struct.Struct(">d")
_MAX_NESTED = 8  # pickles inside pickles
_KEY_TYPES = (str, bytes, bool, type(None))
_SPARSE = {"csc_matrix", "csr_matrix", "coo_matrix", "csc_array", "csr_array", "coo_array"}


def _key(value: Any) -> Any:
    """A key of a dictionary or member of a set.

    Only types whose hashes cannot be made to collide or to take long are accepted.
    """
    if isinstance(value, _KEY_TYPES) or (isinstance(value, int) and abs(value) < 1 << 60):
        return value
    if isinstance(value, float) and abs(value) < 1 << 60:
        return value
    raise UnsafePickleError(f"a dictionary key or set member of type {type(value).__name__}")


class _Machine:
    """The stack machine of the pickle format, without its imports and calls."""

    def __init__(self, file: BinaryIO, budget: Budget, storage=None, nesting: int = 0):
        if nesting > _MAX_NESTED:
            raise UnsafePickleError(f"pickles nested more than {_MAX_NESTED} deep")
        self.file, self.budget, self.storage, self.nesting = file, budget, storage, nesting
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}

    def run(self) -> Any:
        file, budget, stack, memo = self.file, self.budget, self.stack, self.memo
        read, find, unpack = file.read, _TABLE.get, _FLOAT.unpack
        while True:
            code = read(1)
            budget.left -= _OP_COST
            # The most frequent operations come first and are written out, since files of long
            # motions hold millions of them.
            if code == b"G":
                stack.append(unpack(read(8))[0])
            elif code == b"\x94":
                memo[len(memo)] = stack[-1]
            elif code == b"h":
                stack.append(memo[read(1)[0]])
            elif code == b".":
                return stack.pop()
            else:
                operation, reader = find(code) or _unknown(code, file)
                if reader is None:
                    operation(self)
                else:
                    operation(self, reader(file))
            if budget.left < 0:
                budget.spend(0)

    # Values

    def push(self, value: Any) -> None:
        self.stack.append(value)

    def whole_number(self, value: int) -> None:
        if value.bit_length() > 128:
            raise ValueError(f"an integer of {value.bit_length()} bits")
        self.stack.append(value)

    def none(self) -> None:
        self.stack.append(None)

    def true(self) -> None:
        self.stack.append(True)

    def false(self) -> None:
        self.stack.append(False)

    def ignore(self, value: Any = None) -> None:
        del value

    # The stack and the memo

    def mark(self) -> None:
        self.stack.append(_MARK)

    def since_mark(self) -> list[Any]:
        stack = self.stack
        place = len(stack) - 1
        while stack[place] is not _MARK:  # an IndexError below the first entry is a damaged file
            place -= 1
        items = stack[place + 1 :]
        del stack[place:]
        return items

    def pop(self) -> None:
        self.stack.pop()

    def pop_mark(self) -> None:
        self.since_mark()

    def duplicate(self) -> None:
        self.stack.append(self.stack[-1])

    def put(self, index: int) -> None:
        self.memo[index] = self.stack[-1]

    def get(self, index: int) -> None:
        self.stack.append(self.memo[index])

    # Containers

    def new_list(self) -> None:
        self.budget.left -= _CONTAINER_COST
        self.stack.append([])

    def new_dict(self) -> None:
        self.budget.left -= _CONTAINER_COST
        self.stack.append({})

    def new_set(self) -> None:
        self.budget.left -= _CONTAINER_COST
        self.stack.append(set())

    def new_tuple(self) -> None:
        self.stack.append(())

    def marked_list(self) -> None:
        self.stack.append(self.since_mark())

    def marked_tuple(self) -> None:
        self.stack.append(tuple(self.since_mark()))

    def marked_dict(self) -> None:
        items = self.since_mark()
        self.new_dict()
        self._update(items)

    def frozen_set(self) -> None:
        items = self.since_mark()
        self.budget.left -= _CONTAINER_COST
        self.stack.append(frozenset(map(_key, items)))

    def tuple1(self) -> None:
        self.stack[-1] = (self.stack[-1],)

    def tuple2(self) -> None:
        self.stack[-2:] = [(self.stack[-2], self.stack[-1])]

    def tuple3(self) -> None:
        self.stack[-3:] = [(self.stack[-3], self.stack[-2], self.stack[-1])]

    def append(self) -> None:
        value = self.stack.pop()
        self._top(list).append(value)

    def appends(self) -> None:
        items = self.since_mark()
        self._top(list).extend(items)

    def set_item(self) -> None:
        value = self.stack.pop()
        key = self.stack.pop()
        self._update([key, value])

    def set_items(self) -> None:
        self._update(self.since_mark())

    def add_items(self) -> None:
        items = self.since_mark()
        self._top(set).update(map(_key, items))

    def _update(self, items: list[Any]) -> None:
        self.budget.left -= 48 * len(items)  # slots, which dictionaries keep to spare
        self._top(dict).update(
            (_key(key), value) for key, value in zip(items[::2], items[1::2], strict=True)
        )

    def _top(self, kind: type) -> Any:
        top = self.stack[-1]
        if type(top) is not kind:
            raise UnsafePickleError(
                f"entries are added to {_title(top)}, which is no {kind.__name__}"
            )
        return top

    # Names, calls and instances

    def global_name(self, text: str) -> None:
        module, _, name = text.partition(" ")
        self._push_name(module, name)

    def stack_global(self) -> None:
        name, module = self.stack.pop(), self.stack.pop()
        if not (isinstance(name, str) and isinstance(module, str)):
            raise ValueError("a name that is no text")
        self._push_name(module, name)

    def _push_name(self, module: str, name: str) -> None:
        module = _MODULES.get(module, module).replace("numpy.core", "numpy._core")
        self.stack.append(Name(module, name))

    def instance(self) -> None:
        args, name = self.stack.pop(), self.stack.pop()
        self.stack.append(self._instance(name, args))

    def instance_with_keywords(self) -> None:
        keywords = self.stack.pop()
        if keywords != {}:
            raise UnsafePickleError("an instance with keyword arguments")
        self.instance()

    def _instance(self, name: Any, args: Any) -> _Object:
        if not isinstance(name, Name) or type(args) is not tuple:
            raise UnsafePickleError(f"an instance of {_title(name)}")
        module = name.module.split(".")
        if module[0] == "chumpy" or str(name) in (
            "joblib.numpy_pickle.NumpyArrayWrapper",
            *("collections.OrderedDict", "collections.defaultdict"),
        ):
            pass
        elif not (module[:2] == ["scipy", "sparse"] and name.name in _SPARSE):
            raise _refuse(name)
        self.budget.left -= _CONTAINER_COST
        made = _Object(name, args)
        if module[0] == "collections":
            return {}  # type: ignore[return-value]
        return made

    def reduce(self) -> None:
        args, name = self.stack.pop(), self.stack.pop()
        if not isinstance(name, Name):
            raise UnsafePickleError(f"a call of {_title(name)}")
        if type(args) is not tuple:
            raise ValueError(f"a call with {_title(args)} for arguments")
        call = _CALLS.get((name.module, name.name))
        if call is None and name.module == "numpy.dtypes" and name.name in _DTYPE_CLASSES:
            self.stack.append(np.dtype(_DTYPE_CLASSES[name.name]))
            return
        if call is None:
            raise _refuse(name)
        self.stack.append(call(self, *args))

    def build(self) -> None:
        state, target = self.stack.pop(), self.stack[-1]
        if not isinstance(target, _Object):
            raise UnsafePickleError(f"the state of {_title(target)} is set")
        target.state = state
        module, name = target.name.module, target.name.name
        if module.startswith("numpy"):
            value = self._dtype(target.args, state) if name == "dtype" else self._array(state)
        elif module == "joblib.numpy_pickle":
            value = self._joblib_array(state)
        elif module.startswith("scipy"):
            value = _sparse(name, state, self.budget)
        else:
            value = _chumpy_array(state, self.budget)
            if value is None:  # an error only if somebody needs it
                return
        target.value, target.known = value, True

    def persistent(self, identifier: Any) -> None:
        if self.storage is None:
            raise UnsafePickleError("the pickle refers to data outside of it")
        self.stack.append(self.storage(identifier))

    def binary_persistent(self) -> None:
        self.persistent(self.stack.pop())

    # What calls give

    def _reconstructor(self, name: Any, base: Any, state: Any = None) -> _Object:
        if base != Name("builtins", "object") or state is not None:
            raise UnsafePickleError(f"an instance of {_title(name)} with a base that is no object")
        return self._instance(name, ())

    def _ndarray(self, *_: Any) -> _Object:
        self.budget.left -= _CONTAINER_COST
        return _Object(Name("numpy", "ndarray"), ())

    def _new_dtype(self, text: Any, *_: Any) -> _Object:
        if not isinstance(text, str):
            raise UnsafePickleError(f"an array of type {_title(text)}")
        made = _Object(Name("numpy", "dtype"), (text,))
        made.value, made.known = element_type(text), True
        return made

    def _dtype(self, args: tuple[Any, ...], state: Any) -> np.dtype:
        order = state[1]
        if any(part is not None for part in state[2:5]):
            raise UnsafePickleError("an array of several fields; only plain numbers are read")
        made = element_type(args[0])
        # A pickled type also says whether it holds objects, and may lie: its name decides.
        return made.newbyteorder(order) if order in ("<", ">") else made

    def _array(self, state: Any) -> np.ndarray:
        _version, shape, dtype, fortran, data = state
        dtype = _value(dtype)
        if not isinstance(dtype, np.dtype):
            raise UnsafePickleError(f"an array of type {_title(dtype)}")
        if dtype.kind != "O":
            return from_bytes(data, dtype, shape, bool(fortran), self.budget)
        if type(data) is not list or len(data) != _count(shape):
            raise ValueError(f"an array of shape {shape} and {_title(data)}")
        array = np.empty(len(data), object)
        for index, item in enumerate(data):
            array[index] = item
        return array.reshape(shape, order="F" if fortran else "C")

    def _from_buffer(self, data: Any, dtype: Any, shape: Any, order: Any = "C") -> np.ndarray:
        dtype = _value(dtype)
        if not isinstance(dtype, np.dtype) or dtype.kind == "O":
            raise UnsafePickleError(f"an array of type {_title(dtype)}")
        return from_bytes(data, dtype, shape, order == "F", self.budget)

    def _scalar(self, dtype: Any, data: Any = None) -> Any:
        dtype = _value(dtype)
        if not isinstance(dtype, np.dtype) or dtype.kind == "O":
            raise UnsafePickleError(f"a number of type {_title(dtype)}")
        return from_bytes(data, dtype, (), False, self.budget)[()]

    def _joblib_array(self, state: Any) -> Any:
        """The array behind joblib's record, whose bytes follow in the stream."""
        dtype, shape = _value(state["dtype"]), state["shape"]
        if not isinstance(dtype, np.dtype):
            raise UnsafePickleError(f"an array of type {_title(dtype)}")
        if dtype.kind == "O":
            return _Machine(self.file, self.budget, self.storage, self.nesting + 1).run()
        if state.get("numpy_array_alignment_bytes") is not None:
            self.file.read(self.file.read(1)[0])
        size = _count(shape) * dtype.itemsize
        return from_bytes(self.file.read(size), dtype, shape, state["order"] == "F", self.budget)

    def _ordered_dict(self, pairs: Any = ()) -> dict[Any, Any]:
        self.budget.left -= _CONTAINER_COST
        if isinstance(pairs, (list, tuple)):
            return {_key(key): value for key, value in pairs}
        raise UnsafePickleError(f"a dictionary of {_title(pairs)}")

    def _default_dict(self, factory: Any = None) -> dict[Any, Any]:
        del factory
        self.budget.left -= _CONTAINER_COST
        return {}

    def _sequence(self, kind: Callable[[Any], Any]) -> Callable[..., Any]:
        def make(machine: _Machine, items: Any = ()) -> Any:
            if not isinstance(items, (list, tuple)):
                raise UnsafePickleError(f"a {kind.__name__} of {_title(items)}")
            machine.budget.spend(_CONTAINER_COST + 16 * len(items))
            return kind(map(_key, items)) if kind in (set, frozenset) else kind(items)

        return make

    def _bytes(self, text: Any = b"", encoding: Any = "latin-1") -> bytes:
        if isinstance(text, str) and encoding in ("latin1", "latin-1"):
            return text.encode("latin-1")
        if isinstance(text, (bytes, bytearray)):
            return bytes(text)
        raise UnsafePickleError(f"bytes of {_title(text)} in encoding {str(encoding)[:40]}")

    def _complex(self, real: Any, imaginary: Any) -> complex:
        return complex(float(real), float(imaginary))

    def _range(self, *bounds: Any) -> range:
        made = range(*bounds)
        if max(map(abs, bounds), default=0) > 1 << 40 or len(made) > 1_000_000:
            raise TooLargeError(f"{made}, which is more than a million numbers")
        return made

    def _slice(self, *bounds: Any) -> slice:
        if not all(bound is None or isinstance(bound, int) for bound in bounds):
            raise UnsafePickleError("a slice of other things than numbers")
        return slice(*bounds)

    def _tensor(self, storage: Any, offset: Any, size: Any, stride: Any, *_: Any) -> np.ndarray:
        """The array that a PyTorch tensor shows of its storage; strides count elements."""
        numbers = _value(storage)
        if not isinstance(numbers, np.ndarray) or numbers.dtype.kind not in "biuf":
            raise ValueError("a tensor without a storage of numbers")
        size, stride = tuple(map(int, size)), tuple(map(int, stride))
        offset = int(offset)
        last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
        if min((offset, *size, *stride)) < 0 or (0 not in size and last >= numbers.size):
            raise ValueError(f"a tensor of shape {size} that reaches outside its storage")
        self.budget.spend(_count(size) * numbers.itemsize)
        if 0 in size:
            return np.zeros(size, numbers.dtype)
        steps = tuple(step * numbers.itemsize for step in stride)
        return np.lib.stride_tricks.as_strided(numbers[offset:], size, steps).copy()

    def _parameter(self, tensor: Any, *_: Any) -> Any:
        return tensor

    def _legacy_storage(self, data: Any) -> np.ndarray:
        """A storage in the layout of `torch.save` before its zip files.

        Five pickles (a magic number, a version, facts about the machine, the storage's element
        type and size, its key), the number of elements, and the elements.
        """
        file, kinds = io.BytesIO(self._bytes(data)), []

        def storage(identifier: Any) -> np.ndarray:
            kinds.append(torch_dtype(identifier[1]))
            return np.zeros(0)

        def read() -> Any:
            return _Machine(file, self.budget, storage, self.nesting + 1).run()

        if read() != 0x1950A86A20F9469CFC6C:
            raise ValueError("a tensor that is not in PyTorch's storage format")
        _version, machine, _storage, _keys = read(), read(), read(), read()
        if not machine.get("little_endian", True):
            raise ValueError("a tensor with big-endian numbers")
        count = int.from_bytes(file.read(8), "little")
        size = count * kinds[0].itemsize
        return from_bytes(file.read(size), kinds[0], (count,), False, self.budget)


# Values

_STORAGES = {
    "FloatStorage": "<f4", "DoubleStorage": "<f8", "HalfStorage": "<f2", "LongStorage": "<i8",
    "IntStorage": "<i4", "ShortStorage": "<i2", "CharStorage": "i1", "ByteStorage": "u1",
    "BoolStorage": "?",
}  # fmt: skip
_DTYPE_CLASSES = {
    f"{kind}DType": code
    for kind, code in {
        "Bool": "?", "Int8": "i1", "Int16": "i2", "Int32": "i4", "Int64": "i8", "UInt8": "u1",
        "UInt16": "u2", "UInt32": "u4", "UInt64": "u8", "Float16": "f2", "Float32": "f4",
        "Float64": "f8", "Complex64": "c8", "Complex128": "c16",
    }.items()
}  # fmt: skip


def torch_dtype(name: Any) -> np.dtype:
    """Element type of a PyTorch storage class.

    **Raises:** `UnsafePickleError` for another name, or a type that NumPy lacks (bfloat16).
    """
    if not isinstance(name, Name) or name.module != "torch" or name.name not in _STORAGES:
        raise _refuse(name) if isinstance(name, Name) else UnsafePickleError(_title(name))
    return np.dtype(_STORAGES[name.name])


def element_type(text: str) -> np.dtype:
    """The array type of a name such as `<f8`: numbers, text, bytes or objects.

    **Raises:** `ValueError` for any other type, and for entries of no size.
    """
    try:
        dtype = np.dtype(text)
    except (TypeError, ValueError):
        raise ValueError(f"an array of the unknown type {text[:40]!r}") from None
    if dtype.kind not in "biufcSUO" or dtype.fields is not None or dtype.subdtype is not None:
        raise ValueError(f"an array of type {text[:40]!r}; only numbers and text are read")
    if dtype.itemsize == 0:
        raise ValueError(f"an array of type {text[:40]!r}, whose entries have no size")
    return dtype


def from_bytes(data: Any, dtype: np.dtype, shape: Any, fortran: bool, budget: Budget) -> np.ndarray:
    """An array of numbers or text from its bytes, whose number has to be right."""
    if isinstance(data, str):  # Python 2
        data = data.encode("latin-1")
    if not isinstance(data, (bytes, bytearray, memoryview)) or dtype.kind == "O":
        raise ValueError(f"an array of type {dtype.str} made from {_title(data)}")
    count = _count(shape)
    if len(data) != count * dtype.itemsize:
        raise ValueError(
            f"an array of shape {tuple(shape)} and type {dtype.str} needs "
            f"{count * dtype.itemsize} bytes, but {len(data)} are there"
        )
    budget.spend(len(data))
    array = np.frombuffer(data, dtype).copy() if count else np.zeros(0, dtype)
    return array.reshape(shape, order="F" if fortran else "C")


def _count(shape: Any) -> int:
    """Number of entries of an array of this shape. **Raises:** `ValueError` if it is no shape."""
    sizes = tuple(shape)
    if len(sizes) > 32 or not all(type(n) is int and 0 <= n < 1 << 40 for n in sizes):
        raise ValueError(f"an array of shape {str(sizes)[:60]}")
    count = whole = 1
    for n in sizes:
        count, whole = count * n, whole * max(n, 1)
    if whole >= 1 << (40 if count else 24):
        raise TooLargeError(f"an array of shape {sizes}")
    return count


def _value(value: Any) -> Any:
    """What an instance stands for; other values as they are."""
    if not isinstance(value, _Object):
        return value
    if not value.known:
        if value.name.module.split(".")[0] == "chumpy":
            raise UnsafePickleError(
                "a chumpy object without a stored array: convert the file once with chumpy "
                "installed, or use the .npz release of the same model"
            )
        raise ValueError(f"an instance of {value.name} without its state")
    return _value(value.value)


def _chumpy_array(state: Any, budget: Budget) -> np.ndarray | None:
    """The array in the state of a chumpy object, None for an expression of others."""
    if isinstance(state, np.ndarray):
        return state
    if isinstance(state, dict) and "x" in state:
        return _value(state["x"])
    if isinstance(state, dict) and "a" in state and "idxs" in state:
        # chumpy's Select: entries of another array, in another order and shape.
        whole, places = _value(state["a"]), _value(state["idxs"])
        if not isinstance(whole, np.ndarray) or not isinstance(places, (np.ndarray, range)):
            raise UnsafePickleError(f"a selection of {_title(whole)} by {_title(places)}")
        chosen = np.ravel(whole)[np.asarray(places, np.int64)]
        budget.spend(chosen.nbytes)
        shape = state.get("preferred_shape")
        return chosen if shape is None else chosen.reshape(tuple(shape))
    return None


def _sparse(name: str, state: Any, budget: Budget) -> Any:
    """A SciPy sparse matrix from its state, with every index checked."""
    import scipy.sparse

    shape = state.get("_shape", state.get("shape"))
    data = _value(state["data"])
    dense = _count(shape) * data.itemsize
    if dense > budget.allowed:
        raise TooLargeError(f"a sparse matrix of shape {shape}, which takes {dense} bytes")
    budget.spend(2 * data.nbytes)
    if name.startswith("coo"):
        places = [_value(state[k]) for k in ("row", "col")] if "row" in state else [
            _value(part) for part in state["coords"]
        ]  # fmt: skip
        index = tuple(np.asarray(_numbers(part)) for part in places)
        return getattr(scipy.sparse, name)((_numbers(data), index), shape=tuple(shape))
    indices, starts = (_numbers(_value(state[key])) for key in ("indices", "indptr"))
    made = getattr(scipy.sparse, name)((_numbers(data), indices, starts), shape=tuple(shape))
    made.check_format(full_check=True)
    return made


def _numbers(value: Any) -> np.ndarray:
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "biufc":
        raise UnsafePickleError(f"{_title(value)} in a sparse matrix")
    return value


def _title(value: Any) -> str:
    """A value in an error message."""
    if isinstance(value, _Object):
        return f"an instance of {value.name}"
    return str(value) if isinstance(value, Name) else f"a {type(value).__name__}"


class _Resolver:
    """Replaces instances by their values, and checks depth, cycles and shared containers."""

    def __init__(self, budget: Budget):
        self.depth = budget.limits.depth
        # Entries, counting a container as often as something refers to it.
        self.most = budget.allowed // _OP_COST
        self.done: dict[int, tuple[Any, int]] = {}
        self.open: set[int] = set()

    def resolve(self, root: Any) -> Any:
        return self._visit(root, 0)[0]

    def _visit(self, value: Any, depth: int) -> tuple[Any, int]:
        value = _value(value)
        if isinstance(value, np.ndarray):
            if value.dtype.kind != "O":
                return value, 1
        elif not isinstance(value, (dict, list, tuple)):
            return value, 1
        key = id(value)
        if key in self.done:
            return self.done[key]
        if key in self.open:
            raise UnsafePickleError("a container that holds itself")
        if depth > self.depth:
            raise TooLargeError(f"containers nested more than {self.depth} deep")
        self.open.add(key)
        made, size = self._entries(value, depth + 1)
        self.open.discard(key)
        if size > self.most:
            raise TooLargeError("containers that refer to each other again and again")
        self.done[key] = made, size
        return made, size

    def _entries(self, value: Any, depth: int) -> tuple[Any, int]:
        size = 1
        if isinstance(value, np.ndarray):
            flat = [self._visit(item, depth) for item in value.ravel()]
            made = np.empty(len(flat), object)
            for index, (item, more) in enumerate(flat):
                made[index] = item
                size += more
            return made.reshape(value.shape), size
        if isinstance(value, dict):
            for key, item in value.items():
                if type(item) not in _SIMPLE:
                    value[key], more = self._visit(item, depth)
                    size += more
            return value, size + len(value)
        if all(type(item) in _SIMPLE for item in value):
            return value, size + len(value)
        items = list(value) if isinstance(value, tuple) else value
        for index, item in enumerate(items):
            if type(item) not in _SIMPLE:
                items[index], more = self._visit(item, depth)
                size += more
        return (tuple(items) if isinstance(value, tuple) else items), size + len(items)


_SIMPLE = {int, float, bool, str, bytes, complex, type(None)}

_CALLS: dict[tuple[str, str], Callable[..., Any]] = {
    ("builtins", "bytes"): _Machine._bytes,
    ("builtins", "bytearray"): _Machine._bytes,
    ("builtins", "complex"): _Machine._complex,
    ("builtins", "range"): _Machine._range,
    ("builtins", "xrange"): _Machine._range,
    ("builtins", "slice"): _Machine._slice,
    ("builtins", "dict"): _Machine._ordered_dict,
    ("collections", "OrderedDict"): _Machine._ordered_dict,
    ("collections", "defaultdict"): _Machine._default_dict,
    ("copyreg", "_reconstructor"): _Machine._reconstructor,
    ("_codecs", "encode"): _Machine._bytes,
    ("numpy", "dtype"): _Machine._new_dtype,
    ("numpy._core.multiarray", "_reconstruct"): _Machine._ndarray,
    ("numpy._core.multiarray", "scalar"): _Machine._scalar,
    ("numpy._core.numeric", "_frombuffer"): _Machine._from_buffer,
    ("torch", "Size"): _Machine._sequence(None, tuple),  # type: ignore[arg-type]
    ("torch._utils", "_rebuild_tensor_v2"): _Machine._tensor,
    ("torch._utils", "_rebuild_parameter"): _Machine._parameter,
    ("torch.storage", "_load_from_bytes"): _Machine._legacy_storage,
}
for _kind in (list, tuple, set, frozenset):
    _CALLS["builtins", _kind.__name__] = _Machine._sequence(None, _kind)  # type: ignore[arg-type]


def _unknown(code: bytes, file: BinaryIO) -> Any:
    if not code:
        raise ValueError("the pickle ends early")
    raise ValueError(
        f"byte {code!r} at {file.tell() - 1} is no operation of a pickle of plain data"
    )


def _quoted(file: BinaryIO) -> str:
    """A string of Python 2 on a line of its own, which may hold any byte."""
    line = file.readline()
    text = line.strip()
    if not line.endswith(b"\n") or len(text) < 2 or text[:1] not in b"'\"" or text[:1] != text[-1:]:
        raise ValueError("a text without its quotes")
    return codecs.escape_decode(text[1:-1])[0].decode("latin-1")  # type: ignore[attr-defined]


_OPERATIONS: dict[str, Callable[..., None]] = {
    "MARK": _Machine.mark, "POP": _Machine.pop, "POP_MARK": _Machine.pop_mark,
    "DUP": _Machine.duplicate, "NONE": _Machine.none, "NEWTRUE": _Machine.true,
    "NEWFALSE": _Machine.false, "PROTO": _Machine.ignore, "FRAME": _Machine.ignore,
    "EMPTY_LIST": _Machine.new_list, "EMPTY_DICT": _Machine.new_dict,
    "EMPTY_SET": _Machine.new_set, "EMPTY_TUPLE": _Machine.new_tuple,
    "LIST": _Machine.marked_list, "TUPLE": _Machine.marked_tuple, "DICT": _Machine.marked_dict,
    "FROZENSET": _Machine.frozen_set, "TUPLE1": _Machine.tuple1, "TUPLE2": _Machine.tuple2,
    "TUPLE3": _Machine.tuple3, "APPEND": _Machine.append, "APPENDS": _Machine.appends,
    "SETITEM": _Machine.set_item, "SETITEMS": _Machine.set_items, "ADDITEMS": _Machine.add_items,
    "PUT": _Machine.put, "BINPUT": _Machine.put, "LONG_BINPUT": _Machine.put,
    "GET": _Machine.get, "LONG_BINGET": _Machine.get, "GLOBAL": _Machine.global_name,
    "STACK_GLOBAL": _Machine.stack_global, "NEWOBJ": _Machine.instance,
    "NEWOBJ_EX": _Machine.instance_with_keywords, "REDUCE": _Machine.reduce,
    "BUILD": _Machine.build, "PERSID": _Machine.persistent,
    "BINPERSID": _Machine.binary_persistent, "LONG": _Machine.whole_number,
    "LONG1": _Machine.whole_number, "LONG4": _Machine.whole_number,
}  # fmt: skip
_VALUES = (
    "INT", "BININT", "BININT1", "BININT2", "STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE",
    "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8",
    "BYTEARRAY8", "FLOAT",
)  # fmt: skip
_OPERATIONS |= dict.fromkeys(_VALUES, _Machine.push)
_READERS = {"STRING": _quoted}
# Operation and reader of its argument, by the byte that stands in the file.
_TABLE = {
    operation.code.encode("latin-1"): (
        _OPERATIONS[operation.name],
        _READERS.get(operation.name, operation.arg.reader if operation.arg else None),
    )
    for operation in pickletools.opcodes
    if operation.name in _OPERATIONS
}
