"""Avatar files of 0.1.0 and of today on a small body, without any training."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import xavatar_jax as xa
from xavatar_jax.avatar import (
    AbstractRestSurface,
    BodyOnlyAvatar,
    Drivable,
    PosedField,
    body_only,
    load_avatar_header,
    queries,
)
from xavatar_jax.fields import (
    AbstractColorField,
    AbstractPlainGeometry,
    GeometrySpec,
    GeometryValue,
    GridSpacing,
    ModelSpec,
    SkinningSpec,
    build_model,
)
from xavatar_jax.files import load_arrays, save_arrays
from xavatar_jax.kinematics import skin_points

FIXTURES = Path(__file__).parents[1] / "fixtures"


def old_file(kind: str) -> Path:
    return FIXTURES / f"avatar_0.1.0_{kind}.npz"


@pytest.fixture(scope="session")
def same_body(toy_body):
    """The toy body with the checksum in the files: its own may round differently elsewhere."""
    checksum = load_avatar_header(old_file("grid")).body["checksum"]
    return replace(toy_body, source=replace(toy_body.source, checksum=checksum))


@pytest.fixture(scope="session")
def old(same_body):
    return xa.load_avatar(old_file("grid"), body=same_body)


@pytest.mark.parametrize("kind", ["grid", "mlp"])
def test_files_of_0_1_0_load(kind, same_body):
    """Against levels, weights and posed points that 0.1.0 itself computed."""
    avatar = xa.load_avatar(old_file(kind), body=same_body)
    known = json.loads(old_file(kind).with_suffix(".json").read_text())
    assert avatar.spec.skinning.kind == kind
    assert avatar.method == "xavatar"
    assert avatar.options["preset"] == "quick"
    params = xa.BodyParams.create(
        same_body, **{name: np.asarray(known[name]) for name in ("pose", "expression", "transl")}
    )
    own = avatar._own(params)
    points = jnp.asarray(known["points"], jnp.float32)
    condition = avatar.model.geometry.condition(own)
    found = queries.levels(avatar.model, points, condition)
    np.testing.assert_allclose(found, known["levels"], atol=2e-4)
    np.testing.assert_allclose(avatar.skin_weights(points), known["weights"], atol=2e-5)
    transforms = xa.bone_transforms(same_body, own)
    posed = queries.skin(avatar.model, points, transforms)
    np.testing.assert_allclose(posed, known["posed"], atol=2e-5)


def test_a_file_of_today_holds_the_same_model(old, same_body, tmp_path):
    old.save(tmp_path / "avatar.npz")
    again = xa.load_avatar(tmp_path / "avatar.npz", body=same_body)
    assert eqx.tree_equal(again.model, old.model)
    assert (again.spec, again.search) == (old.spec, old.search)
    assert load_arrays(tmp_path / "avatar.npz")[1]["format"] == 2


def test_unknown_training_options_do_not_matter(same_body, old, tmp_path):
    arrays, header = load_arrays(old_file("grid"))
    header["config"]["renamed"] = {"later": True}
    header["config"]["optimiser"] = "gone"
    save_arrays(tmp_path / "a.npz", arrays, header)
    again = xa.load_avatar(tmp_path / "a.npz", body=same_body)
    assert eqx.tree_equal(again.model, old.model)
    assert again.options["renamed"] == {"later": True}


def test_another_layout_of_grids_is_read_from_the_file(old, same_body, tmp_path):
    """As if the spacing in the spec meant another number of nodes than when it was written."""
    old.save(tmp_path / "a.npz")
    arrays, header = load_arrays(tmp_path / "a.npz")
    header["model"]["skinning"]["correction"]["body"] *= 0.7
    header["model"]["geometry"]["log2_size"] += 1
    save_arrays(tmp_path / "a.npz", arrays, header)
    again = xa.load_avatar(tmp_path / "a.npz", body=same_body)
    points = jnp.asarray(same_body.template[::50], jnp.float32)
    np.testing.assert_array_equal(again.skin_weights(points), old.skin_weights(points))
    condition = old.model.geometry.condition(xa.canonical_params(same_body))
    np.testing.assert_array_equal(
        queries.levels(again.model, points, condition),
        queries.levels(old.model, points, condition),
    )


def _change(header, path, value):
    *way, last = path.split(".")
    for name in way:
        header = header[name]
    header[last] = value


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("steps", "many", "steps must be int"),
        ("method", None, "method must be str"),
        ("body.checksum", 3, "checksum must be str"),
        ("model.skinning.kind", 3, r"model\.skinning\.kind must be like"),
        ("model.geometry.spacing", ["a"], r"model\.geometry\.spacing must be like"),
        ("model.geometry.color", 3, "unknown entry 'color'"),
        ("search.keep", 1.5, r"search\.keep must be like"),
        ("skeleton", "half", "skeleton must be"),
        ("format", "2", "format must be int"),
    ],
)
def test_wrong_headers_name_file_and_entry(old, tmp_path, path, value, message):
    old.save(tmp_path / "a.npz")
    arrays, header = load_arrays(tmp_path / "a.npz")
    _change(header, path, value)
    save_arrays(tmp_path / "a.npz", arrays, header)
    with pytest.raises(ValueError, match=rf"a\.npz: .*{message}"):
        load_avatar_header(tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a * np.nan, "is not finite"),
        (lambda a: a[0], "has shape"),
        (lambda a: a[:, :3], "do not fit: skinning"),
        (lambda a: a.astype(str), "has type"),
    ],
)
def test_wrong_arrays_name_file_and_entry(old, same_body, tmp_path, change, message):
    old.save(tmp_path / "a.npz")
    arrays, header = load_arrays(tmp_path / "a.npz")
    arrays["skinning.correction"] = change(arrays["skinning.correction"])
    save_arrays(tmp_path / "a.npz", arrays, header)
    with pytest.raises(ValueError, match=rf"a\.npz.*{message}"):
        xa.load_avatar(tmp_path / "a.npz", body=same_body)


def test_avatars_motions_and_frames_can_be_compared(old, same_body):
    params = xa.BodyParams.zeros(same_body, (2,))
    motion = xa.Motion.from_params(params, fps=30.0)
    frame = xa.Frames.from_meshes(
        [(np.asarray(same_body.template), np.asarray(same_body.faces))] * 2, params
    )[0]
    for value in (old, motion, frame):
        assert value == value
        assert value != replace(value)
        assert len({value, value}) == 1


# Queries


@pytest.fixture(scope="session")
def asked(old, same_body):
    """Points of which the canonical place is known: canonical points, skinned."""
    known = json.loads(old_file("grid").with_suffix(".json").read_text())
    params = xa.BodyParams.create(same_body, pose=np.asarray(known["pose"]))
    points = jnp.asarray(known["points"], jnp.float32)
    posed = queries.skin(old.model, points, xa.bone_transforms(same_body, old._own(params)))
    return params, points, posed


def test_found_is_tested_on_the_field_itself(old, same_body, asked):
    """Searched on the table of another field, whose roots are none of this one's."""
    params, _, posed = asked
    rng = np.random.default_rng(0)
    table = old.posed_field.table
    noisy = table.node_weights * jnp.asarray(rng.uniform(0.2, 1, table.node_weights.shape))
    noisy = (noisy / noisy.sum(1, keepdims=True)).astype(jnp.float32)
    misled = replace(old)
    field = replace(old.posed_field, table=replace(table, node_weights=noisy))
    misled.__dict__["posed_field"] = field
    answer = misled.query(posed, params)
    transforms = xa.bone_transforms(same_body, old._own(params))
    weights = old.skin_weights(answer.x_c)
    carried = np.asarray(skin_points(answer.x_c, weights, transforms))
    residual = np.linalg.norm(carried - np.asarray(posed), axis=1)
    found = np.asarray(answer.found)
    assert found.sum() > len(found) / 2
    # Twice the tolerance: the residual is computed by another program.
    assert residual[found].max() < 2 * old.search.atol


def test_the_best_root_is_no_worse_than_the_known_one(old, asked):
    params, points, posed = asked
    condition = old.model.geometry.condition(old._own(params))
    level = np.asarray(queries.levels(old.model, points, condition))
    answer = old.query(posed, params)
    found = np.asarray(answer.found)
    assert found.mean() > 0.9
    assert (np.asarray(answer.level) > level - 0.02)[found].mean() > 0.95


def test_occupancy_runs_under_jit_and_uses_the_search_spec(old, asked):
    params, _, posed = asked
    rows = jnp.asarray(old.start_rows(np.asarray(posed), params))
    assert isinstance(old.posed_field, PosedField)
    expected = old.occupancy(posed, params)
    found = jax.jit(xa.occupancy)(old.posed_field, posed, params, rows)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    # No residual is below 0.
    strict = replace(old.posed_field, search=replace(old.search, atol=0.0))
    assert not eqx.filter_jit(xa.query)(strict, posed, params, rows).found.any()


# Drivable


def small(avatar: xa.Avatar) -> xa.Avatar:
    """With a coarse surface, which takes a second."""
    mesh = avatar.canonical_mesh(cell=0.02)
    avatar.__dict__["_base_mesh"] = mesh
    return avatar


class Stripes(AbstractColorField):
    """Red rises with x; green is the normal's z."""

    def __call__(self, x_c, feature=None, normal=None):
        assert normal is not None
        return jnp.stack([jax.nn.sigmoid(x_c[0]), 0.5 + 0.5 * normal[2], jnp.zeros(())])


def test_colors_reach_meshes_animations_and_files(old, same_body, tmp_path):
    pytest.importorskip("pygltflib")
    from gltf.reader import GltfFile

    avatar = small(replace(old, model=replace(old.model, color=Stripes())))
    params = xa.BodyParams.zeros(same_body, (2,))
    mesh = avatar.surface(params[0])
    assert mesh.colors is not None
    expected = 255 / (1 + np.exp(-avatar.canonical_mesh().vertices[:, 0]))
    np.testing.assert_allclose(mesh.colors[:, 0], expected, atol=1)
    animation = avatar.animate(params)
    np.testing.assert_array_equal(animation[1].colors, mesh.colors)
    report = avatar.export_glb(tmp_path / "a.glb", params, expressions=False, verbose=False)
    assert "COLOR_0" in GltfFile(report.path).primitive["attributes"]


@pytest.fixture(scope="session")
def body_only_avatar(same_body):
    """SNARF's kind of avatar, not fitted."""
    cut = body_only(same_body)
    spacing = GridSpacing(body=0.1, hands=0.06, face=0.06, band=0.06)
    spec = ModelSpec(
        SkinningSpec(grid=spacing, correction=spacing),
        GeometrySpec(
            spacing=(0.15, 0.08), trunk=0.08, hands=0.08, face=0.08, log2_size=11, width=16
        ),
    )
    betas = np.zeros(10, np.float32)
    model = build_model(spec, cut, key=jax.random.key(0), betas=betas)
    # A ball at the pelvis: nothing is fitted here.
    avatar = xa.Avatar(cut, betas, replace(model, geometry=Ball()), spec, method="snarf")
    return BodyOnlyAvatar(same_body, small(avatar))


class Ball(AbstractPlainGeometry):
    """The level of a ball around the origin."""

    def condition(self, params):
        return params.pose[0]

    def __call__(self, x_c, condition):
        return GeometryValue(20 * (0.12 - jnp.sqrt(jnp.sum(x_c**2) + 1e-12)))


def test_body_only_avatars_are_driven_by_the_whole_body(body_only_avatar, same_body, tmp_path):
    avatar = body_only_avatar
    assert isinstance(avatar, Drivable)
    assert isinstance(avatar.rest, AbstractRestSurface)
    assert avatar.rest.weights.shape[0] == same_body.num_joints
    np.testing.assert_allclose(avatar.rest.weights.sum(0), 1, atol=1e-5)
    rng = np.random.default_rng(0)
    params = xa.BodyParams.create(same_body, pose=0.2 * rng.standard_normal((3, 55, 3)))
    animation = avatar.animate(params)
    for k in range(3):
        own = avatar.surface(params[k])
        np.testing.assert_allclose(animation[k].vertices, own.vertices, atol=1e-4)
        assert np.array_equal(animation[k].faces, own.faces)
    report = avatar.export_glb(tmp_path / "a.glb", params, verbose=False)
    assert (report.num_joints, report.num_targets) == (55, 0)
    assert report.total_loss.mean < 1
    frames = xa.Frames.from_meshes([(own.vertices, own.faces)] * 3, params, body=same_body)
    result = xa.evaluate(avatar, frames[2:], verbose=False).mean
    assert result.cd_mm.all < 0.01


def test_body_only_avatars_are_saved_and_loaded(body_only_avatar, same_body, tmp_path):
    avatar = body_only_avatar
    avatar.save(tmp_path / "a.npz")
    again = xa.load_avatar(tmp_path / "a.npz", body=same_body, model=avatar.avatar.model)
    assert isinstance(again, BodyOnlyAvatar)
    assert again.method == "snarf"
    assert again.body is same_body
    assert again.avatar.body.tree == avatar.avatar.body.tree
    assert eqx.tree_equal(again.avatar.model.skinning, avatar.avatar.model.skinning)
