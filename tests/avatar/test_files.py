"""The avatar's file: what is in it, and what is not."""

import json
import shutil
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import xavatar_jax as xa
from xavatar_jax.avatar import load_avatar_body
from xavatar_jax.body import canonical_params
from xavatar_jax.files import load_arrays, save_arrays


@pytest.fixture(scope="module")
def saved(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("avatar") / "avatar.npz"
    run.fit.avatar.save(path)
    return path


def test_round_trip_gives_the_same_mesh(run, saved):
    again = xa.load_avatar(saved, body=run.body)
    params = run.test[0].params
    assert np.array_equal(again.mesh(params).vertices, run.fit.avatar.mesh(params).vertices)
    assert again.spec == run.fit.avatar.spec
    assert again.search == run.fit.avatar.search
    assert again.options["preset"] == run.config.preset
    assert again.steps == run.config.steps


def test_round_trip_keeps_what_expressions_do(run, tmp_path):
    heard = jnp.stack([jnp.full(10, -1.0), jnp.full(10, 1.0)])
    fields = eqx.tree_at(lambda m: m.geometry.expression_range, run.fit.avatar.model, heard)
    avatar = replace(run.fit.avatar, model=fields)
    avatar.save(tmp_path / "avatar.npz")
    again = xa.load_avatar(tmp_path / "avatar.npz", body=run.body)
    assert np.array_equal(again.model.geometry.expression_range, heard)
    neutral = canonical_params(run.body)
    smile = replace(neutral, expression=jnp.asarray([1.0, *9 * [0.0]]))
    vertices = again.mesh(smile).vertices
    assert np.array_equal(vertices, avatar.mesh(smile).vertices)
    assert np.abs(vertices - avatar.mesh(neutral).vertices).max() > 0.002


def test_round_trip_keeps_weights_that_a_run_did_not_learn(run, tmp_path):
    """Another run did: this one continued from it."""
    model = run.fit.avatar.model
    moved = eqx.tree_at(lambda m: m.skinning.correction, model, replace_fn=lambda c: c + 0.3)
    avatar = replace(run.fit.avatar, model=moved)
    avatar.save(tmp_path / "avatar.npz")
    again = xa.load_avatar(tmp_path / "avatar.npz", body=run.body)
    assert np.array_equal(again.model.skinning.correction, moved.skinning.correction)


def test_body_is_found_by_its_path(run, saved):
    assert load_avatar_body(saved).source == run.body.source


def test_file_holds_nothing_of_the_body(run, saved):
    """No array has a row a vertex, or a grid node: those come from the body's own arrays."""
    arrays, header = load_arrays(saved)
    grids = run.fit.avatar.model.skinning.grids
    for name, value in arrays.items():
        assert run.body.num_vertices not in value.shape, name
        assert grids.num_nodes not in value.shape, name
        assert "moves" not in name
    assert header["body"]["checksum"] == run.body.source.checksum
    json.dumps(header, allow_nan=False)


def test_missing_body_says_what_is_needed(saved, tmp_path):
    arrays, header = load_arrays(saved)
    header["body"]["path"] = "/nowhere/SMPLX_NEUTRAL.npz"
    path = tmp_path / "avatar.npz"
    save_arrays(path, arrays, header)
    with pytest.raises(FileNotFoundError, match=r"SMPLX_NEUTRAL\.npz.*load_avatar\(path, body="):
        xa.load_avatar(path)


def test_other_body_is_refused(run, saved, tmp_path):
    arrays, header = load_arrays(saved)
    header["body"]["checksum"] = "0" * 64
    path = tmp_path / "avatar.npz"
    save_arrays(path, arrays, header)
    with pytest.raises(ValueError, match="fitted on another body"):
        xa.load_avatar(path, body=run.body)


def test_newer_format_is_refused(run, saved, tmp_path):
    arrays, header = load_arrays(saved)
    header["format"] += 1
    path = tmp_path / "avatar.npz"
    save_arrays(path, arrays, header)
    with pytest.raises(ValueError, match="format 3; this version"):
        xa.load_avatar(path, body=run.body)


def test_damaged_file_is_named(run, saved, tmp_path):
    path = tmp_path / "avatar.npz"
    shutil.copy(saved, path)
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(ValueError, match=r"avatar\.npz"):
        xa.load_avatar(path, body=run.body)


def test_missing_array_is_named(run, saved, tmp_path):
    arrays, header = load_arrays(saved)
    name = next(n for n in arrays if "table" in n)
    del arrays[name]
    path = tmp_path / "avatar.npz"
    save_arrays(path, arrays, header)
    with pytest.raises(ValueError, match="no array 'geometry"):
        xa.load_avatar(path, body=run.body)


def test_interrupt_while_saving_leaves_the_old_file(run, saved, tmp_path, monkeypatch):
    path = tmp_path / "avatar.npz"
    shutil.copy(saved, path)
    before = path.read_bytes()

    def interrupt(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez", interrupt)
    with pytest.raises(KeyboardInterrupt):
        run.fit.avatar.save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
