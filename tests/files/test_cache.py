"""Cache entries are verified when they are read, and built again when they are damaged."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import numpy as np
import pytest

from xavatar_jax.files import CacheNotice, cache_path, cached, load_npz


def build_file(path):
    with open(path, "wb") as file:
        np.savez(file, a=np.arange(1000), b=np.ones(3))


def read_file(path):
    arrays = load_npz(path)
    if arrays.keys() != {"a", "b"}:
        raise ValueError("other entries")
    return arrays


def build_folder(path):
    for name in ("one/a.npz", "two/b.npz", "two/c.npz"):
        (path / name).parent.mkdir(exist_ok=True)
        build_file(path / name)


def read_folder(path):
    return sorted(p.relative_to(path).as_posix() for p in path.rglob("*.npz"))


def test_an_entry_is_built_once(tmp_path):
    calls = []

    def build(path):
        calls.append(path)
        build_file(path)

    path = tmp_path / "new" / "entry.npz"
    for _ in range(2):
        np.testing.assert_array_equal(cached(path, build, read_file)["a"], np.arange(1000))
    assert len(calls) == 1
    assert calls[0] != path  # a temporary file, renamed
    assert os.listdir(path.parent) == ["entry.npz"]


def cut(path):
    path.write_bytes(path.read_bytes()[:700])


def flip(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))


def empty(path):
    path.write_bytes(b"")


def other(path):
    with open(path, "wb") as file:
        np.savez(file, a=np.arange(3))


def folder(path):
    path.unlink()
    path.mkdir()


@pytest.mark.parametrize("damage", [cut, flip, empty, other, folder])
def test_a_damaged_file_is_built_again_with_one_notice(tmp_path, damage):
    path = tmp_path / "entry.npz"
    cached(path, build_file, read_file)
    damage(path)
    with pytest.warns(CacheNotice, match=r"entry\.npz: damaged cache entry, built again") as said:
        assert len(cached(path, build_file, read_file)["a"]) == 1000
    assert len(said) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cached(path, build_file, read_file)


def test_a_file_of_an_earlier_version_is_read_as_it_is(tmp_path):
    path = tmp_path / "entry.npz"
    build_file(path)
    assert len(cached(path, pytest.fail, read_file)["a"]) == 1000


def test_an_error_of_reading_a_sound_entry_is_not_damage(tmp_path):
    def read(path):
        raise ValueError("another body")

    for name, build, is_folder in (("a.npz", build_file, False), ("b", build_folder, True)):
        cached(tmp_path / name, build, lambda path: None, folder=is_folder)
        with pytest.raises(ValueError, match="another body"):
            cached(tmp_path / name, pytest.fail, read, folder=is_folder)


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: (path / "two/b.npz").unlink(),
        lambda path: flip(path / "one/a.npz"),
        lambda path: (path / "two/b.npz").rename(path / "two/d.npz"),
        lambda path: build_file(path / "two/d.npz"),
        lambda path: (path / "contents.json").unlink(),
        lambda path: (path / "contents.json").write_text("[1]"),
    ],
)
def test_a_damaged_folder_is_built_again_with_one_notice(tmp_path, damage):
    path = tmp_path / "entry"
    names = cached(path, build_folder, read_folder, folder=True)
    assert names == ["one/a.npz", "two/b.npz", "two/c.npz"]
    assert cached(path, pytest.fail, read_folder, folder=True) == names
    damage(path)
    with pytest.warns(CacheNotice, match="damaged cache entry, built again") as said:
        assert cached(path, build_folder, read_folder, folder=True) == names
    assert len(said) == 1
    assert cached(path, pytest.fail, read_folder, folder=True) == names
    assert os.listdir(tmp_path) == ["entry"]


def test_an_unwritable_cache_is_named(tmp_path):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(OSError, match=r"cannot write to the cache: .*XDG_CACHE_HOME") as error:
        cached(tmp_path / "file" / "entry.npz", build_file, read_file)
    assert "entry.npz" in str(error.value)


def test_a_full_disk_leaves_nothing(tmp_path):
    def build(path):
        build_file(path)
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match=r"No space left on device.*entry\.npz"):
        cached(tmp_path / "entry.npz", build, read_file)
    assert os.listdir(tmp_path) == []


def test_the_folder_of_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_path() == tmp_path / "xdg" / "xavatar_jax"
    assert not cache_path().exists()
    assert cache_path(tmp_path / "mine") == tmp_path / "mine"


def test_without_a_home_folder_the_cache_is_temporary(monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # no HOME, no such user
    path = cache_path()
    assert path.is_absolute()
    assert "~" not in path.parts
    assert isinstance(path, Path)


@pytest.mark.parametrize("place", ["file/cache", "missing"])
def test_info_needs_no_cache(tmp_path, monkeypatch, place):
    from xavatar_jax.cli.info import machine_facts

    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / place))
    assert machine_facts()["cache"] == {
        "path": str(tmp_path / place / "xavatar_jax"),
        "size": "does not exist yet",
    }
    assert os.listdir(tmp_path) == ["file"]
