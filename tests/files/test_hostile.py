"""Hostile files: forged pointers, changes to the process, and a few bytes that ask for gigabytes."""

# Streams are bytes on one line.
# ruff: noqa: E501

from __future__ import annotations

import bz2
import gc
import gzip
import io
import lzma
import pickle
import resource
import struct
import time
import zipfile
import zlib
from collections import OrderedDict

import numpy as np
import pytest
import scipy.sparse

from xavatar_jax.files import (
    Limits,
    TooLargeError,
    UnsafePickleError,
    is_torch,
    load_json,
    load_npy,
    load_npz,
    load_pickle,
    load_torch,
)


def text(value: str) -> bytes:
    return b"X" + struct.pack("<I", len(value)) + value.encode()


def raw(value: bytes) -> bytes:
    return b"B" + struct.pack("<I", len(value)) + value


def number(value: int) -> bytes:
    data = value.to_bytes(value.bit_length() // 8 + 1, "little", signed=True)
    return b"\x8a" + bytes([len(data)]) + data


def header(descr: str, shape: str, data: bytes = b"") -> bytes:
    line = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(line)) + line + data


@pytest.fixture
def bounded():
    """Bounds the processor time and the memory of a test, without those of collecting garbage
    among everything that earlier tests hold."""
    gc.freeze()
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    yield
    gc.unfreeze()
    assert time.process_time() - start < 5
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown < 800_000  # kilobytes


FORGED = {
    "by a call": b"\x80\x02cnumpy\nndarray\n(K\x01\x85" + text("O") + raw(b"A" * 8) + b"tR.",
    "by its state": b"\x80\x02cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85"
    + raw(b"b") + b"\x87R(K\x01K\x01\x85cnumpy\ndtype\n" + text("O8") + b"K\x00K\x01\x87R"
    + b"(K\x03" + text("|") + b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89"
    + raw(b"A" * 8) + b"tb.",
    "from a buffer": b"\x80\x02cnumpy._core.numeric\n_frombuffer\n(" + raw(b"A" * 8)
    + b"cnumpy\ndtype\n" + text("O8") + b"K\x00K\x01\x87RK\x01\x85" + text("C") + b"tR.",
    "as a scalar": b"\x80\x02cnumpy._core.multiarray\nscalar\ncnumpy\ndtype\n" + text("O8")
    + b"K\x00K\x01\x87R" + raw(b"A" * 8) + b"\x86R.",
    "as a field": b"\x80\x02cnumpy._core.multiarray\nscalar\ncnumpy\ndtype\n" + text("O,i4")
    + b"K\x00K\x01\x87R" + raw(b"A" * 12) + b"\x86R.",
}  # fmt: skip


@pytest.mark.parametrize("name", FORGED)
@pytest.mark.parametrize("container", ["pkl", "npz", "npy"])
def test_bytes_never_become_pointers(tmp_path, name, container):
    path = tmp_path / f"forged.{container}"
    entry = header("|O", "()", FORGED[name])
    if container == "npz":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("poses.npy", entry)
    else:
        path.write_bytes(FORGED[name] if container == "pkl" else entry)
    load = {"pkl": load_pickle, "npz": load_npz, "npy": load_npy}[container]
    with pytest.raises(ValueError, match=rf"forged\.{container}"):
        load(path)


@pytest.mark.parametrize(
    "target",
    [b"cscipy.sparse\ncsr_matrix\n", b"ccopyreg\n_reconstructor\n", b"cnumpy\nndarray\n",
     b"ccollections\nOrderedDict\n", b"cchumpy.ch\nCh\n"],
)  # fmt: skip
def test_states_change_no_class_or_function(tmp_path, target):
    path = tmp_path / "evil.pkl"
    for state in (b"N}" + text("toarray") + b"K\x01s\x86", b"}" + text("toarray") + b"K\x01s"):
        path.write_bytes(b"\x80\x02" + target + state + b"b.")
        with pytest.raises(UnsafePickleError, match=r"evil\.pkl.*state"):
            load_pickle(path)
    assert callable(scipy.sparse.csr_matrix.toarray)
    assert not hasattr(OrderedDict, "toarray")


def shared(levels: int, key: bool = False) -> bytes:
    """Lists (or tuples) of eight times the one before."""
    body = b"\x80\x02" + (b"(tq\x00" if key else b"]q\x00")
    for k in range(levels):
        eight = (b"h" + bytes([k])) * 8
        body += (
            b"(" + eight + b"tq" + bytes([k + 1]) if key else b"](" + eight + b"eq" + bytes([k + 1])
        )
    return body + (b"}h" + bytes([levels]) + b"K\x01s." if key else b".")


def strided(count: int) -> bytes:
    one = b"cnumpy\ndtype\n" + text("f8") + b"\x85R"
    storage = (
        b"cnumpy._core.numeric\n_frombuffer\n("
        + raw(bytes(8))
        + one
        + b"K\x01\x85"
        + text("C")
        + b"tR"
    )
    return (
        b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n(" + storage + b"K\0(" + number(count)
        + b"t(K\0ttR."
    )  # fmt: skip


COLLIDING = (
    b"\x80\x02}(" + b"".join(number(k * (2**61 - 1)) + b"N" for k in range(1, 60_000)) + b"u."
)
HUGE = {
    "a range in a list": b"\x80\x02cbuiltins\nlist\ncbuiltins\nrange\n" + number(10**9) + b"\x85R\x85R.",
    "a range": b"\x80\x02cbuiltins\nrange\n" + number(10**18) + b"\x85R.",
    "a stride of zero": strided(4 * 10**8),
    "shared lists": shared(20),
    "shared tuples as a key": shared(20, key=True),
    "keys that collide": COLLIDING,
    "sets by the byte": b"\x80\x04" + b"\x8f" * 3_000_000 + b".",
    "bytearrays of a number": b"\x80\x02cbuiltins\nbytearray\n" + number(10**10) + b"\x85R.",
    "another encoding": b"\x80\x02c_codecs\nencode\n" + text("ab" * 10_000) + text("punycode") + b"\x86R.",
    "a list in itself": b"\x80\x02]q\x00h\x00a.",
    "deep lists": b"\x80\x02" + b"]" * 200_000 + b"a" * 199_999 + b".",
    "a long number": b"\x80\x02\x8b" + struct.pack("<i", 2_000_000) + b"\x01" * 2_000_000 + b".",
    "pickles in pickles": b"\x80\x02cjoblib.numpy_pickle\nNumpyArrayWrapper\n)\x81}(" + text("dtype")
    + b"cnumpy\ndtype\n" + text("O") + b"\x85R" + text("shape") + b")" + text("order") + text("C") + b"ub",
}  # fmt: skip


@pytest.mark.parametrize("name", HUGE)
def test_small_pickles_take_little(tmp_path, bounded, name):
    path = tmp_path / "small.pkl"
    path.write_bytes(HUGE[name] * (500 if name == "pickles in pickles" else 1))
    with pytest.raises(ValueError, match=r"small\.pkl"):
        load_pickle(path)


@pytest.mark.parametrize(
    "pack", [lambda d: zlib.compress(d, 1), gzip.compress, bz2.compress, lzma.compress],
    ids=["zlib", "gzip", "bz2", "xz"],
)  # fmt: skip
def test_compressed_data_is_unpacked_no_further_than_allowed(tmp_path, bounded, pack):
    path = tmp_path / "bomb.pkl"
    path.write_bytes(pack(bytes(30_000_000)))
    with pytest.raises(TooLargeError, match=r"bomb\.pkl.*more than 2000000 bytes"):
        load_pickle(path, limits=Limits(free=2_000_000, ratio=2))


def test_archives_are_not_unpacked_if_their_entries_are_too_large(tmp_path, bounded):
    path = tmp_path / "bomb.npz"
    np.savez_compressed(path, a=np.zeros(2_000_000), b=np.zeros(2_000_000))
    with pytest.raises(TooLargeError, match=r"bomb\.npz.*32000\d\d\d bytes unpacked"):
        load_npz(path, limits=Limits(free=1_000_000))
    assert len(load_npz(path)["a"]) == 2_000_000
    with pytest.raises(TooLargeError, match=r"bomb\.npz.*the limit is 1000 bytes"):
        load_npz(path, limits=Limits(total=1000))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (header("<f8", "(1000000000000,)"), "shape"),
        (header("<f8", "(99999999999999999999,)"), "shape"),
        (header("<f8", "(3, )", bytes(16)), "needs 24 bytes, but 16 are there"),
        (header("<f8", "(True,)", bytes(80)), "header"),
        (header("|S0", "(1000000000,)"), "no size"),
        (header("<M8", "(1,)", bytes(8)), "only numbers and text"),
        (header("|V8", "(1,)", bytes(8)), "only numbers and text"),
        (header("<f8", "(0, 1000000000000)"), "shape"),
        (b"\x93NUMPY\x01\x00" + struct.pack("<H", 5001) + b"-" * 5000 + b"1", "header"),
        (b"\x93NUMPY\x09\x00", "version"),
    ],
)
def test_headers_that_cannot_be(tmp_path, bounded, content, words):
    path = tmp_path / "odd.npy"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"odd\.npy: .*{words}"):
        load_npy(path)
    with zipfile.ZipFile(tmp_path / "odd.npz", "w") as archive:
        archive.writestr("entry.npy", content)
    with pytest.raises(ValueError, match=rf"odd\.npz: .*entry\.npy.*{words}"):
        load_npz(tmp_path / "odd.npz")


def test_arrays_of_several_fields_are_named(tmp_path):
    np.savez(tmp_path / "odd.npz", pair=np.zeros(3, [("a", "f8"), ("b", "i4")]))
    with pytest.raises(ValueError, match=r"odd\.npz.*pair\.npy.*several fields"):
        load_npz(tmp_path / "odd.npz")


@pytest.mark.parametrize("cut", [1, 4, 100])
def test_bytes_lost_on_the_way_are_an_error_that_names_the_file(tmp_path, cut):
    np.savez(tmp_path / "a.npz", poses=np.zeros((4, 165)), trans=np.zeros((4, 3)))
    data = (tmp_path / "a.npz").read_bytes()
    (tmp_path / "a.npz").write_bytes(data[:200] + data[200 + cut :])
    with pytest.raises(ValueError, match=r"a\.npz: not a readable \.npz archive"):
        load_npz(tmp_path / "a.npz")


def test_a_sparse_matrix_with_indices_outside_is_refused(tmp_path):
    matrix = scipy.sparse.csc_matrix(np.eye(3))
    matrix.indices = np.array([0, 1, 900], np.int32)
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(matrix, 2))
    with pytest.raises(ValueError, match=r"a\.pkl"):
        load_pickle(tmp_path / "a.pkl")
    large = scipy.sparse.csc_matrix((10**6, 10**6))
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(large, 2))
    with pytest.raises(TooLargeError, match=r"a\.pkl.*sparse"):
        load_pickle(tmp_path / "a.pkl")


def test_strings_of_python_2_hold_any_byte(tmp_path):
    """The text protocol, in which SMPL's first models were published."""
    path = tmp_path / "a.pkl"
    data = repr(struct.pack("<2d", -1.5, 1e300))[1:].encode()
    stream = b"(dp1\nS'v'\np2\ncnumpy.core.multiarray\n_reconstruct\np3\n(cnumpy\nndarray\np4\n(I0\ntp5\n"
    stream += (
        b"S'b'\np6\ntp7\nRp8\n(I1\n(I2\ntp9\ncnumpy\ndtype\np10\n(S'f8'\np11\nI0\nI1\ntp12\nRp13\n"
    )
    stream += b"(I3\nS'<'\np14\nNNNI-1\nI-1\nI0\ntp15\nbI00\nS" + data + b"\np16\ntp17\nbs."
    path.write_bytes(stream)
    np.testing.assert_array_equal(load_pickle(path)["v"], [-1.5, 1e300])


def test_json_that_is_deep_or_not_finite(tmp_path):
    path = tmp_path / "a.json"
    for content in (b"[" * 100_000, b"[" * 500 + b"]" * 500, b'{"a": ', b"\xff\xfe[]"):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"a\.json: "):
            load_json(path)
    path.write_text(f'{{"a": [{10**400}, 1e999, 3, -{10**30}]}}')
    assert load_json(path)["a"] == [np.inf, np.inf, 3, -1e30]


# PyTorch


class Storage:
    def __init__(self, kind, key, array):
        self.identifier = ("storage", kind, key, "cpu", array.size)


def torch_file(path, entries, named, *, change=lambda data: data):
    """The layout of `torch.save`: a pickle of views and the numbers of each beside it."""
    import sys

    rebuild = type("_rebuild_tensor_v2", (), {"__module__": "torch._utils"})
    kinds = {"f": "FloatStorage", "i": "LongStorage"}
    modules = {name: type(sys)(name) for name in ("torch", "torch._utils")}
    modules["torch._utils"]._rebuild_tensor_v2 = rebuild
    classes = {}
    for kind in kinds.values():
        classes[kind] = type(kind, (), {"__module__": "torch"})
        setattr(modules["torch"], kind, classes[kind])
    for name, module in modules.items():
        named.setitem(sys.modules, name, module)
    arrays = []

    class Tensor:
        def __init__(self, array):
            self.array = array

        def __reduce__(self):
            storage = Storage(classes[kinds[self.array.dtype.kind]], str(len(arrays)), self.array)
            arrays.append(self.array)
            steps = tuple(s // self.array.itemsize for s in self.array.strides)
            return rebuild, (storage, 0, self.array.shape, steps, False, OrderedDict())

    class Pickler(pickle.Pickler):
        def persistent_id(self, obj):
            return obj.identifier if isinstance(obj, Storage) else None

    stream = io.BytesIO()
    Pickler(stream, 2).dump(
        {n: Tensor(v) if isinstance(v, np.ndarray) else v for n, v in entries.items()}
    )
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("results/data.pkl", stream.getvalue())
        archive.writestr("results/byteorder", "little")
        for k, array in enumerate(arrays):
            archive.writestr(f"results/data/{k}", change(array.tobytes()))
        archive.writestr("results/version", "3\n")
    return path


def test_files_of_pytorch_are_read_without_it(tmp_path, monkeypatch):
    pose = np.arange(12, dtype=np.float32).reshape(4, 3)
    entries = {"pose": pose, "ids": np.array([3, 1]), "name": "walk", "steps": [1, 2]}
    path = torch_file(tmp_path / "results.pt", entries, monkeypatch)
    assert is_torch(path)
    found = load_torch(path)
    np.testing.assert_array_equal(found["pose"], pose, strict=True)
    np.testing.assert_array_equal(found["ids"], [3, 1])
    assert (found["name"], found["steps"]) == ("walk", [1, 2])
    np.savez(tmp_path / "a.npz", pose=pose)
    assert not is_torch(tmp_path / "a.npz")


def test_damaged_files_of_pytorch_are_named(tmp_path, monkeypatch):
    entries = {"pose": np.zeros(3, np.float32)}
    path = torch_file(tmp_path / "results.pt", entries, monkeypatch, change=lambda data: data[:-1])
    with pytest.raises(ValueError, match=r"results\.pt.*needs 12 bytes, but 11"):
        load_torch(path)

    class Evil:
        def __reduce__(self):
            return print, ("run",)

    path = torch_file(tmp_path / "results.pt", {"x": Evil()}, monkeypatch)
    with pytest.raises(UnsafePickleError, match=r"results\.pt.*builtins\.print"):
        load_torch(path)
