"""Pickles of strangers: data comes out, code does not run."""

from __future__ import annotations

import io
import os
import pickle
import struct
import sys
import types
import zipfile
from collections import OrderedDict

import numpy as np
import pytest
import scipy.sparse
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from xavatar_jax.files import UnsafePickleError, load_npz, load_pickle

FUZZ = settings(deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))


def write(path, value, protocol=2):
    path.write_bytes(pickle.dumps(value, protocol))
    return path


@pytest.fixture
def chumpy(monkeypatch):
    """Stand-ins with chumpy's module names and the state that chumpy pickles."""

    def module(name, *classes):
        made = types.ModuleType(name)
        for cls in classes:
            cls.__module__ = name
            setattr(made, cls.__name__, cls)
        monkeypatch.setitem(sys.modules, name, made)

    class Ch:
        def __init__(self, **state):
            self.__dict__.update(state)

    class Select(Ch):
        pass

    class Add(Ch):
        pass

    for cls in (Ch, Select, Add):
        cls.__qualname__ = cls.__name__
    module("chumpy")
    module("chumpy.ch", Ch, Add)
    module("chumpy.reordering", Select)
    return types.SimpleNamespace(Ch=Ch, Select=Select, Add=Add)


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_plain_data_of_every_protocol(tmp_path, protocol):
    value = {
        "array": np.arange(6, dtype=np.float32).reshape(2, 3),
        "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "scalar": np.float64(1.5),
        "objects": np.array(["a", None, 3], dtype=object),
        "nested": [1, (2.5, True, None), {"x": {4}}, "ü", b"bytes", 1 + 2j],
        "ordered": OrderedDict(a=1),
    }
    found = load_pickle(write(tmp_path / "a.pkl", value, protocol))
    assert list(found) == list(value)
    np.testing.assert_array_equal(found["array"], value["array"])
    assert found["array"].dtype == np.float32
    np.testing.assert_array_equal(found["fortran"], value["fortran"])
    np.testing.assert_array_equal(found["objects"], value["objects"])
    assert found["scalar"] == 1.5
    assert found["nested"] == value["nested"]
    assert found["ordered"] == value["ordered"]


@pytest.mark.parametrize("make", ["csc_matrix", "csr_matrix", "coo_matrix", "csc_array"])
def test_sparse_matrices(tmp_path, make):
    dense = np.array([[0.0, 2.0, 0.0], [1.0, 0.0, 0.0]])
    found = load_pickle(write(tmp_path / "a.pkl", {"J": getattr(scipy.sparse, make)(dense)}))
    np.testing.assert_array_equal(found["J"].toarray(), dense)


def test_a_python_2_pickle_of_an_array(tmp_path):
    """The bytes that Python 2 and NumPy 1 write: byte strings, old module names, numeric flags."""

    def short(text: bytes) -> bytes:
        return b"U" + bytes([len(text)]) + text

    data = struct.pack("<3d", 1.5, -2.0, 1e300)
    stream = b"\x80\x02}" + short(b"shapedirs")
    stream += b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85" + short(b"b")
    stream += b"\x87R(K\x01K\x03\x85cnumpy\ndtype\n" + short(b"f8") + b"K\x00K\x01\x87R"
    stream += b"(K\x03" + short(b"<") + b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    stream += b"\x89" + short(data) + b"tb" + b"s."
    path = tmp_path / "old.pkl"
    path.write_bytes(stream)
    np.testing.assert_array_equal(load_pickle(path)["shapedirs"], [1.5, -2.0, 1e300])


def test_a_sparse_matrix_under_its_old_module_name(tmp_path):
    stream = pickle.dumps({"J": scipy.sparse.csc_matrix(np.eye(2))}, 2)
    assert b"scipy.sparse._csc\n" in stream
    path = tmp_path / "old.pkl"
    path.write_bytes(stream.replace(b"scipy.sparse._csc\n", b"scipy.sparse.csc\n"))
    np.testing.assert_array_equal(load_pickle(path)["J"].toarray(), np.eye(2))


@pytest.mark.parametrize("protocol", [0, 2])
def test_chumpy_arrays_come_back_as_arrays(tmp_path, chumpy, protocol):
    values = np.arange(12.0).reshape(2, 3, 2)
    order = np.array([11, 0, 5, 5])
    model = {
        "shapedirs": chumpy.Ch(x=values, _dirty_vars=set(), _itr=None),
        # A Select picks entries of another array: the wrapped array alone would be wrong.
        "picked": chumpy.Select(a=chumpy.Ch(x=values), idxs=order, preferred_shape=(2, 2)),
        "flat": chumpy.Select(a=values, idxs=order),
        "list": [chumpy.Ch(x=values)],
    }
    path = write(tmp_path / "a.pkl", model, protocol)
    found = load_pickle(path)
    np.testing.assert_array_equal(found["shapedirs"], values)
    np.testing.assert_array_equal(found["picked"], [[11, 0], [5, 5]])
    np.testing.assert_array_equal(found["flat"], [11, 0, 5, 5])
    np.testing.assert_array_equal(found["list"][0], values)


def test_a_chumpy_expression_is_refused_and_not_guessed(tmp_path, chumpy):
    path = write(tmp_path / "a.pkl", {"v": chumpy.Add(a=np.ones(3), b=np.ones(3))})
    with pytest.raises(UnsafePickleError, match=r"a\.pkl.*chumpy"):
        load_pickle(path)


class Attack:
    """Runs a command when an ordinary unpickler reads it."""

    def __init__(self, call, *args):
        self.call, self.args = call, args

    def __reduce__(self):
        return self.call, self.args


def attacks(marker):
    command = f"touch {marker}"
    return {
        "os.system": Attack(os.system, command),
        "eval": Attack(eval, f"open({str(marker)!r}, 'w').close()"),
        "getattr": Attack(getattr, "text", "upper"),
        "open": Attack(open, str(marker), "w"),
        "numpy": Attack(np.save, str(marker), 1),
        "partial": Attack(__import__("functools").partial, os.system, command),
    }


@pytest.mark.parametrize("name", ["os.system", "eval", "getattr", "open", "numpy", "partial"])
@pytest.mark.parametrize("container", ["pkl", "npz"])
def test_code_is_refused_and_not_run(tmp_path, name, container):
    marker = tmp_path / "ran"
    payload = {"v_template": attacks(marker)[name]}
    path = tmp_path / f"evil.{container}"
    if container == "pkl":
        path.write_bytes(pickle.dumps(payload, 2))
        load = load_pickle
    else:
        np.savez(path, good=np.zeros(2), evil=np.array(payload, dtype=object))
        load = load_npz
    with pytest.raises(UnsafePickleError, match=rf"evil\.{container}") as error:
        load(path)
    assert "not plain data" in str(error.value)
    assert not marker.exists()


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("os", "system"),
        ("posix", "system"),
        ("builtins", "eval"),
        ("builtins", "getattr"),
        ("__builtin__", "eval"),
        ("numpy.core.multiarray", "fromfile"),
        ("numpy", "load"),
        ("numpy.dtypes", "__builtins__"),
        ("scipy.sparse", "load_npz"),
        ("scipy.sparse.os", "system"),
        ("chumpy", "os.system"),
        ("chumpy.ch", "os"),
        ("pickle", "loads"),
        ("builtins", "object.__subclasses__"),
    ],
)
def test_no_name_outside_the_list_is_found(tmp_path, module, name):
    """By the stack opcode, which also takes dotted names."""
    marker = f"touch {tmp_path}/ran"
    stream = b"\x80\x04"
    for text in (module, name):
        stream += b"\x8c" + bytes([len(text)]) + text.encode()
    stream += b"\x93\x8c" + bytes([len(marker)]) + marker.encode() + b"\x85R."
    path = tmp_path / "evil.pkl"
    path.write_bytes(stream)
    with pytest.raises(UnsafePickleError, match=r"evil\.pkl"):
        load_pickle(path)
    assert not (tmp_path / "ran").exists()


def test_object_arrays_in_an_npz(tmp_path):
    joint2num = {"pelvis": 0, "left_hip": 1}
    np.savez(
        tmp_path / "a.npz",
        plain=np.arange(3),
        joint2num=np.array(joint2num, dtype=object),
        ragged=np.array([np.zeros(2), np.zeros(3)], dtype=object),
    )
    found = load_npz(tmp_path / "a.npz")
    assert found["joint2num"] == joint2num
    np.testing.assert_array_equal(found["plain"], [0, 1, 2])
    assert [len(row) for row in found["ragged"]] == [2, 3]


def test_compressed_archives(tmp_path, rng):
    values = rng.normal(size=(5, 4))
    np.savez_compressed(tmp_path / "a.npz", a=values, b=values.T)
    found = load_npz(tmp_path / "a.npz")
    np.testing.assert_array_equal(found["a"], values)
    np.testing.assert_array_equal(found["b"], values.T)


@pytest.mark.parametrize("load", [load_pickle, load_npz])
def test_missing_files(tmp_path, load):
    with pytest.raises(FileNotFoundError, match="nothing"):
        load(tmp_path / "nothing")


@pytest.mark.parametrize("content", [b"", b"hello", b"\x80\x02", b"PK\x03\x04", b"\x93NUMPY"])
@pytest.mark.parametrize("load", [load_pickle, load_npz])
def test_other_files_are_refused_by_name(tmp_path, load, content):
    path = tmp_path / "odd.bin"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"odd\.bin"):
        load(path)


ARRAYS = pickle.dumps({"a": np.arange(4.0), "b": scipy.sparse.csc_matrix(np.eye(3))}, 2)
# Bytes are changed in this one alone: NumPy itself trusts the flags of a pickled dtype.
PLAIN = pickle.dumps({"a": {3, 4}, "b": [1, "x", {"c": (2, None)}], "d": 1.5, "e": 1j}, 2)


@pytest.mark.parametrize("whole", [ARRAYS, PLAIN], ids=["arrays", "plain"])
def test_a_truncated_pickle_is_an_error_of_ours(tmp_path, whole):
    path = tmp_path / "cut.pkl"
    for length in range(0, len(whole), 3):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"cut\.pkl"):
            load_pickle(path)


@settings(FUZZ, max_examples=150)
@given(st.integers(0, len(PLAIN) - 1), st.integers(0, 255))
def test_a_damaged_pickle_is_an_error_of_ours_or_data(tmp_path_factory, place, byte):
    path = tmp_path_factory.mktemp("fuzz") / "damaged.pkl"
    damaged = bytearray(PLAIN)
    damaged[place] = byte
    path.write_bytes(bytes(damaged))
    try:
        load_pickle(path)
    except ValueError as error:  # UnsafePickleError is one
        assert "damaged.pkl" in str(error)  # noqa: PT017 (an error is one of two good ends)


@settings(FUZZ, max_examples=60)
@given(st.integers(0, 10_000), st.integers(1, 255))
def test_a_damaged_object_array_is_an_error_of_ours_or_data(tmp_path_factory, place, flip):
    payload = io.BytesIO()
    np.save(payload, np.array({"pelvis": 0, "x": [1, 2.5]}, dtype=object))
    damaged = bytearray(payload.getvalue())
    damaged[place % len(damaged)] ^= flip
    path = tmp_path_factory.mktemp("fuzz") / "damaged.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("joint2num.npy", bytes(damaged))
    try:
        load_npz(path)
    except ValueError as error:
        assert "damaged.npz" in str(error)  # noqa: PT017 (an error is one of two good ends)
