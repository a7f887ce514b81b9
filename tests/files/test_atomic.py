"""Nothing half-written under the final name, whatever interrupts the writing."""

from __future__ import annotations

import errno
import os
import stat

import numpy as np
import pytest

from xavatar_jax.files import atomic_folder, atomic_path, save_arrays


class Interrupted(BaseException):
    """Like a KeyboardInterrupt: no subclass of Exception."""


def entries(folder):
    return sorted(path.name for path in folder.iterdir())


def test_the_file_appears_whole_and_only_at_the_end(tmp_path):
    target = tmp_path / "new" / "mesh.ply"
    with atomic_path(target) as temporary:
        temporary.write_bytes(b"half")
        assert not target.exists()
        assert temporary.parent == target.parent  # the same file system, so a rename is atomic
        assert temporary.suffix == ".ply"
        temporary.write_bytes(b"whole")
    assert target.read_bytes() == b"whole"
    assert entries(target.parent) == ["mesh.ply"]


@pytest.mark.parametrize("error", [ValueError, OSError, KeyboardInterrupt, SystemExit, Interrupted])
@pytest.mark.parametrize("former", [None, b"former"], ids=["new", "replacing"])
def test_an_error_leaves_the_former_file_and_nothing_else(tmp_path, error, former):
    target = tmp_path / "a.npz"
    if former is not None:
        target.write_bytes(former)
    with pytest.raises(error), atomic_path(target) as temporary:  # noqa: PT012
        temporary.write_bytes(b"half")
        raise error("stop")
    assert entries(tmp_path) == ([] if former is None else ["a.npz"])
    if former is not None:
        assert target.read_bytes() == former


def test_permissions_are_those_of_an_ordinary_file(tmp_path):
    ordinary = tmp_path / "ordinary"
    ordinary.write_bytes(b"")
    with atomic_path(tmp_path / "ours") as temporary:
        temporary.write_bytes(b"")
    assert stat.S_IMODE((tmp_path / "ours").stat().st_mode) == stat.S_IMODE(ordinary.stat().st_mode)


def test_a_rename_that_fails_leaves_nothing(tmp_path, monkeypatch):
    def refuse(source, target):
        raise OSError(errno.ENOSPC, "No space left on device", str(target))

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(OSError, match="No space left"), atomic_path(tmp_path / "a") as temporary:
        temporary.write_bytes(b"data")
    assert entries(tmp_path) == []


@pytest.mark.parametrize("former", [False, True], ids=["new", "replacing"])
def test_a_full_disk_while_arrays_are_written(tmp_path, monkeypatch, former):
    target = tmp_path / "avatar.npz"
    if former:
        save_arrays(target, {"a": np.arange(3)}, {})
        before = target.read_bytes()

    def fill(file, **arrays):
        file.write(b"PK\x03\x04 the first bytes")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np, "savez", fill)
    with pytest.raises(OSError, match="No space left"):
        save_arrays(target, {"a": np.arange(5)}, {})
    assert entries(tmp_path) == (["avatar.npz"] if former else [])
    if former:
        assert target.read_bytes() == before


def test_a_folder_where_the_file_should_be_stays(tmp_path):
    (tmp_path / "taken").mkdir()
    with pytest.raises(OSError), atomic_path(tmp_path / "taken") as temporary:  # noqa: PT011
        temporary.write_bytes(b"x")
    assert entries(tmp_path) == ["taken"]


def test_a_folder_appears_whole(tmp_path):
    target = tmp_path / "deep" / "capture"
    with atomic_folder(target) as temporary:
        (temporary / "one").write_text("1")
        assert not target.exists()
    assert entries(target) == ["one"]
    assert entries(target.parent) == ["capture"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_interrupted_folder_leaves_nothing(tmp_path, error):
    with pytest.raises(error), atomic_folder(tmp_path / "capture") as temporary:  # noqa: PT012
        (temporary / "one").write_text("1")
        raise error
    assert entries(tmp_path) == []


def test_a_folder_made_meanwhile_by_another_process_stays(tmp_path):
    target = tmp_path / "capture"
    with atomic_folder(target) as temporary:
        (temporary / "ours").write_text("1")
        target.mkdir()
        (target / "theirs").write_text("2")
    assert entries(target) == ["theirs"]
    assert entries(tmp_path) == ["capture"]
