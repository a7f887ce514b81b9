"""Arrays and a JSON header in one file, back as they were."""

from __future__ import annotations

import zipfile

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from xavatar_jax.files import (
    flatten_named,
    header_entry,
    load_arrays,
    load_header,
    refuse_newer,
    save_arrays,
    unflatten_named,
)


class Layer(eqx.Module):
    weight: jax.Array
    name: str = eqx.field(static=True)


class Net(eqx.Module):
    layers: tuple[Layer, ...]
    scale: jax.Array


def some_net(fill: float) -> Net:
    return Net((Layer(jnp.full((2, 3), fill), "a"), Layer(jnp.full(4, fill), "b")), jnp.array(fill))


def test_round_trip(tmp_path):
    arrays = {
        "f32": np.linspace(0, 1, 7, dtype=np.float32).reshape(7, 1),
        "f64": np.array(np.pi),
        "labels": np.array([[1, -2]], np.int8),
        "flags": np.array([True, False]),
        "empty": np.zeros((0, 3)),
        "columns": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "words": np.array(["one", "zwölf"]),
    }
    header = {"version": "1", "steps": [1, 2], "nested": {"ok": True, "none": None, "x": 0.1}}
    save_arrays(tmp_path / "a.npz", arrays, header)
    found, found_header = load_arrays(tmp_path / "a.npz")
    assert found_header == header
    assert load_header(tmp_path / "a.npz") == header
    assert set(found) == set(arrays)
    for name, value in arrays.items():
        np.testing.assert_array_equal(found[name], value)
        assert found[name].dtype == value.dtype
    # No pickle inside: NumPy reads it with pickles forbidden.
    with np.load(tmp_path / "a.npz", allow_pickle=False) as file:
        np.testing.assert_array_equal(file["f32"], arrays["f32"])


def test_objects_are_not_pickled(tmp_path):
    with pytest.raises(ValueError, match="Object arrays cannot be saved"):
        save_arrays(tmp_path / "a.npz", {"any": np.array([{}, None], object)}, {})
    assert not list(tmp_path.iterdir())


def test_a_tree_round_trip_by_path(tmp_path):
    net = some_net(2.5)
    named = flatten_named(net)
    assert set(named) == {"layers[0].weight", "layers[1].weight", "scale"}
    save_arrays(tmp_path / "net.npz", named, {})
    arrays, _ = load_arrays(tmp_path / "net.npz")
    back = unflatten_named(some_net(0.0), arrays, source="net.npz")
    assert eqx.tree_equal(back, net)


def test_a_tree_that_does_not_fit_names_leaf_and_shapes():
    arrays = {k: np.asarray(v) for k, v in flatten_named(some_net(1.0)).items()}
    with pytest.raises(ValueError, match=r"here\.npz: no array 'scale'"):
        unflatten_named(
            some_net(0.0), {k: v for k, v in arrays.items() if k != "scale"}, source="here.npz"
        )
    arrays["layers[1].weight"] = np.zeros(5)
    with pytest.raises(ValueError, match=r"here\.npz: layers\[1\]\.weight .*\(5,\).*\(4,\)"):
        unflatten_named(some_net(0.0), arrays, source="here.npz")


def test_a_file_of_another_kind_is_refused(tmp_path):
    np.savez(tmp_path / "other.npz", a=np.zeros(2))
    with pytest.raises(ValueError, match=r"other\.npz.*header"):
        load_arrays(tmp_path / "other.npz")
    with pytest.raises(FileNotFoundError):
        load_arrays(tmp_path / "none.npz")


@pytest.mark.parametrize("cut", [1, 40, 200])
def test_a_truncated_file_is_refused(tmp_path, cut):
    path = tmp_path / "a.npz"
    save_arrays(path, {"a": np.arange(100.0)}, {"k": 1})
    path.write_bytes(path.read_bytes()[:-cut])
    with pytest.raises(ValueError, match=r"a\.npz"):
        load_arrays(path)


def test_a_flipped_byte_is_noticed(tmp_path):
    path = tmp_path / "a.npz"
    save_arrays(path, {"a": np.arange(100.0)}, {"k": 1})
    with zipfile.ZipFile(path) as archive:
        place = archive.getinfo("a.npy").header_offset + 400
    damaged = bytearray(path.read_bytes())
    damaged[place] ^= 0xFF
    path.write_bytes(bytes(damaged))
    with pytest.raises(ValueError, match=r"a\.npz"):
        load_arrays(path)


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        (np.frombuffer(b"[]", np.uint8), "holds a list, expected an object"),
        (np.frombuffer(b"[" * 100_000, np.uint8), "nested"),
        (np.frombuffer(b'{"a": 1', np.uint8), "not readable JSON"),
        (np.frombuffer(b"\xff\xfe", np.uint8), "not readable JSON"),
        (np.zeros(0, np.uint8), "not readable JSON"),
        (np.zeros(3), "is no array of bytes"),
        (np.array({"a": 1}, object), "is no array of bytes"),
    ],
)
def test_damaged_headers_are_errors_that_name_the_file(tmp_path, entry, words):
    path = tmp_path / "a.npz"
    np.savez(path, **{"header.json": entry})
    for load in (load_arrays, load_header):
        with pytest.raises(ValueError, match=rf"a\.npz.*{words}"):
            load(path)


def test_entries_of_headers_are_checked():
    header = {"format": "1", "body": {"path": 3}, "step": 1.5, "on": True, "rate": 2}
    with pytest.raises(ValueError, match=r"a\.npz: .*'format' is '1', expected a whole number"):
        refuse_newer("a.npz", header, 1, written_by="0.1")
    with pytest.raises(ValueError, match=r"a\.npz: .*no entry 'format'"):
        refuse_newer("a.npz", {}, 1, written_by="0.1")
    for name, kind, words in (
        ("body.path", str, "is '3', expected text"),
        ("body.kind", str, "no entry 'body.kind'"),
        ("step.path", str, "no entry"),
        ("step", int, "expected a whole number"),
        ("on", int, "expected a whole number"),
        ("body", list, "expected a list"),
    ):
        with pytest.raises(ValueError, match=rf"a\.npz: .*{words}"):
            header_entry("a.npz", header, name, kind)
    assert header_entry("a.npz", header, "rate", float) == 2


def test_arrays_that_hold_no_numbers_are_named(tmp_path):
    arrays = {k: np.asarray(v) for k, v in flatten_named(some_net(1.0)).items()}
    arrays["scale"] = np.array("word")
    with pytest.raises(ValueError, match=r"here\.npz: scale holds <U4, expected numbers"):
        unflatten_named(some_net(0.0), arrays, source="here.npz")
    np.savez(
        tmp_path / "a.npz", **{"header.json": np.frombuffer(b"{}", np.uint8)}, x=np.array([None])
    )
    with pytest.raises(ValueError, match=r"a\.npz: x holds Python objects"):
        load_arrays(tmp_path / "a.npz")
