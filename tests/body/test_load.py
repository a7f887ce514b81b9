"""Model files of every kind and layout, and what is said about those that are wrong."""

from __future__ import annotations

import os
import pickle
import sys
import types

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
from helpers import COLUMNS, PARENTS, toy_arrays

from xavatar_jax.body import load_body
from xavatar_jax.files import UnsafePickleError


def write_npz(path, arrays):
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **arrays)
    return path


@pytest.fixture
def smplx():
    return toy_arrays(PARENTS["smplx"], columns=20, num_vertices=70)


@pytest.fixture
def chumpy_array(monkeypatch):
    """Wraps an array as chumpy pickles it."""
    module = types.ModuleType("chumpy.ch")

    class Ch:
        def __init__(self, x):
            self.x = x

    Ch.__module__, Ch.__qualname__ = "chumpy.ch", "Ch"
    module.Ch = Ch
    monkeypatch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
    monkeypatch.setitem(sys.modules, "chumpy.ch", module)
    return Ch


def assert_holds(body, arrays):
    for found, key in (
        (body.template, "v_template"),
        (body.pose_dirs, "posedirs"),
        (body.weights, "weights"),
        (body.joint_regressor, "J_regressor"),
        (body.faces, "f"),
    ):
        np.testing.assert_allclose(found, arrays[key], rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("kind", PARENTS)
@pytest.mark.parametrize("suffix", ["npz", "pkl"])
def test_each_kind_from_each_format(tmp_path, chumpy_array, kind, suffix):
    arrays = toy_arrays(PARENTS[kind], columns=COLUMNS[kind])
    path = tmp_path / f"{kind.upper()}_FEMALE.{suffix}"
    if suffix == "npz":
        write_npz(path, arrays)
    else:  # as Python 2 wrote them: a sparse regressor, chumpy arrays, an unsigned root parent
        stored = {
            **arrays,
            "J_regressor": scipy.sparse.csc_matrix(arrays["J_regressor"]),
            "shapedirs": chumpy_array(arrays["shapedirs"]),
            "posedirs": chumpy_array(arrays["posedirs"]),
            "kintree_table": np.where(
                arrays["kintree_table"] < 0, 2**32 - 1, arrays["kintree_table"]
            ),
            "bs_type": "lrotmin",
        }
        path.write_bytes(pickle.dumps(stored, 2))
    body = load_body(path)
    assert_holds(body, arrays)
    assert body.kind == kind
    assert body.source.gender == "female"
    assert body.source.path == str(path)
    assert len(body.source.checksum) == 64
    assert body.tree.parents == PARENTS[kind]
    columns = np.concatenate([body.shape_dirs, body.expression_dirs], axis=-1)
    np.testing.assert_allclose(columns, arrays["shapedirs"], rtol=1e-6)
    joints = arrays["J_regressor"] @ arrays["v_template"]
    np.testing.assert_allclose(body.joint_template, joints, atol=1e-6)


def test_a_checksum_is_of_contents(tmp_path):
    arrays = toy_arrays(PARENTS["smplx"], columns=COLUMNS["smplx"])
    one = load_body(write_npz(tmp_path / "a.npz", arrays))
    (tmp_path / "b.pkl").write_bytes(pickle.dumps(arrays, 2))
    few = load_body(tmp_path / "b.pkl", num_betas=2, num_expression=1)
    assert few.source.checksum == one.source.checksum
    rounded = {**arrays, "v_template": arrays["v_template"] * (1 + 1e-12)}
    assert load_body(write_npz(tmp_path / "c.npz", rounded)).source.checksum == one.source.checksum
    for key in ("v_template", "shapedirs", "posedirs", "hands_meanl"):
        other = {**arrays, key: arrays[key] + 1e-5}
        found = load_body(write_npz(tmp_path / f"{key}.npz", other))
        assert found.source.checksum != one.source.checksum


@pytest.mark.parametrize(
    ("columns", "betas", "expression"), [(400, 300, 100), (20, 10, 10), (10, 10, 0)]
)
def test_shape_and_expression_columns_of_smplx(tmp_path, columns, betas, expression):
    arrays = toy_arrays(PARENTS["smplx"], columns=columns)
    body = load_body(write_npz(tmp_path / "a.npz", arrays))
    assert (body.num_betas, body.num_expression) == (betas, expression)
    np.testing.assert_allclose(body.shape_dirs, arrays["shapedirs"][..., :betas], rtol=1e-6)
    np.testing.assert_allclose(body.expression_dirs, arrays["shapedirs"][..., betas:], rtol=1e-6)


def test_fewer_coefficients(tmp_path):
    arrays = toy_arrays(PARENTS["smplx"], columns=400)
    path = write_npz(tmp_path / "a.npz", arrays)
    body = load_body(path, num_betas=16, num_expression=50)
    np.testing.assert_allclose(body.shape_dirs, arrays["shapedirs"][..., :16], rtol=1e-6)
    np.testing.assert_allclose(body.expression_dirs, arrays["shapedirs"][..., 300:350], rtol=1e-6)
    with pytest.raises(ValueError, match=r"a\.npz: num_betas=301, but the file has 300"):
        load_body(path, num_betas=301)
    with pytest.raises(ValueError, match=r"a\.npz: num_expression=101, but the file has 100"):
        load_body(path, num_expression=101)


def test_precision_follows_the_setting(tmp_path, smplx, x64):
    body = load_body(write_npz(tmp_path / "a.npz", smplx))
    assert body.template.dtype == jnp.float64
    np.testing.assert_array_equal(body.template, smplx["v_template"])


@pytest.mark.parametrize(
    ("kind", "gender", "place"),
    [
        ("smplx", "neutral", "smplx/SMPLX_NEUTRAL.npz"),
        ("smplx", "male", "smplx/SMPLX_MALE.pkl"),
        ("smpl", "female", "smpl/SMPL_FEMALE.pkl"),
        ("smplh", "male", "smplh/SMPLH_MALE.npz"),
        ("mano", "right", "mano/MANO_RIGHT.pkl"),
        ("smplx", "neutral", "SMPLX_NEUTRAL.npz"),
    ],
)
def test_folder_layout(tmp_path, monkeypatch, kind, gender, place):
    arrays = toy_arrays(PARENTS[kind], columns=COLUMNS[kind])
    path = tmp_path / "models" / place
    path.parent.mkdir(parents=True)
    if path.suffix == ".npz":
        np.savez(path, **arrays)
    else:
        path.write_bytes(pickle.dumps(arrays, 2))
    body = load_body(tmp_path / "models", kind=kind, gender=gender)
    assert body.source.path == str(path)
    assert body.kind == kind
    if kind != "mano":
        assert body.source.gender == gender
    monkeypatch.setenv("SMPLX_MODEL_DIR", str(tmp_path / "models"))
    assert load_body(kind=kind, gender=gender).source.path == str(path)


@pytest.mark.parametrize(
    ("kind", "site"), [("smplx", "smpl-x.is.tue.mpg.de"), ("mano", "mano.is.tue.mpg.de"),
                       ("smpl", "smpl.is.tue.mpg.de")],
)  # fmt: skip
def test_a_missing_model_lists_what_was_tried_and_where_to_get_it(tmp_path, kind, site):
    with pytest.raises(FileNotFoundError) as error:
        load_body(tmp_path, kind=kind, gender="male")
    name = f"{kind.upper()}_MALE"
    for tried in (tmp_path / kind / f"{name}.npz", tmp_path / kind / f"{name}.pkl",
                  tmp_path / f"{name}.npz", tmp_path / f"{name}.pkl"):  # fmt: skip
        assert str(tried) in str(error.value)
    assert site in str(error.value)
    assert "synthetic_body" in str(error.value)


def test_a_missing_file(tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError, match=r"Tried:\n  .*none\.npz"):
        load_body(tmp_path / "none.npz")
    monkeypatch.delenv("SMPLX_MODEL_DIR", raising=False)
    with pytest.raises(FileNotFoundError, match="SMPLX_MODEL_DIR"):
        load_body()


@pytest.mark.parametrize(
    ("key", "shape", "expected"),
    [
        ("v_template", (70, 2), r"\('n', 3\)"),
        ("v_template", (71, 3), r"weights has shape \(70, 55\), expected \(71, 55\)"),
        ("f", (140,), r"\('n', 3\)"),
        ("f", (140, 4), r"\('n', 3\)"),
        ("kintree_table", (55,), r"\(2, 'n'\)"),
        ("weights", (70, 54), r"\(70, 55\)"),
        ("J_regressor", (54, 70), r"\(55, 70\)"),
        ("posedirs", (70, 3, 207), r"\(70, 3, 486\)"),
        ("shapedirs", (69, 3, 40), r"\(70, 3, 'n'\)"),
        ("shapedirs", (70, 120), r"\(70, 3, 'n'\)"),
        ("hands_meanl", (44,), r"\(45,\)"),
        ("hands_componentsr", (6, 44), r"\('n', 45\)"),
        ("part_labels", (69,), r"\(70,\)"),
        ("vertex_colors", (70, 4), r"\(70, 3\)"),
    ],
)
def test_a_wrong_shape_names_file_entry_and_both_shapes(tmp_path, smplx, key, shape, expected):
    path = write_npz(tmp_path / "broken.npz", {**smplx, key: np.zeros(shape)})
    with pytest.raises(ValueError, match=expected) as error:
        load_body(path)
    assert str(path) in str(error.value)
    assert key in str(error.value) or "weights" in str(error.value)


@pytest.mark.parametrize(
    "key", ["v_template", "f", "kintree_table", "weights", "J_regressor", "posedirs", "shapedirs"]
)
def test_a_missing_entry_lists_those_there_are(tmp_path, smplx, key):
    path = write_npz(tmp_path / "a.npz", {k: v for k, v in smplx.items() if k != key})
    with pytest.raises(ValueError, match=rf"a\.npz: no entry '{key}'; the file has"):
        load_body(path)


@pytest.mark.parametrize("key", ["v_template", "weights", "J_regressor", "posedirs", "shapedirs"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_entries_that_are_not_finite(tmp_path, smplx, key, value):
    smplx[key].flat[5] = value
    path = write_npz(tmp_path / "a.npz", smplx)
    with pytest.raises(ValueError, match=rf"a\.npz: {key} has entries that are not finite"):
        load_body(path)


def test_weights_are_shares_of_one(tmp_path, smplx):
    """Rounded ones are divided by their sum, with a word; negative or empty rows are refused."""
    whole = smplx["weights"]
    rounded = np.where(whole < 0.02, 0, whole)
    assert rounded.sum(1).min() < 0.99
    with pytest.warns(UserWarning, match=r"a\.npz: weights of \d+ vertices do not sum to one"):
        body = load_body(write_npz(tmp_path / "a.npz", {**smplx, "weights": rounded}))
    np.testing.assert_allclose(body.weights, rounded / rounded.sum(1)[:, None], atol=1e-6)
    for row in (0 * whole[7], np.where(np.arange(whole.shape[1]) == 1, 1.3, -0.3 / 54)):
        bad = whole.copy()
        bad[7] = row
        path = write_npz(tmp_path / "b.npz", {**smplx, "weights": bad})
        with pytest.raises(
            ValueError,
            match=r"weights of 1 vertices are negative.*vertex 7; expected rows that sum to one",
        ):
            load_body(path)


def test_faces_labels_and_trees_out_of_range(tmp_path, smplx):
    faces = smplx["f"].copy()
    faces[3, 1] = 70
    path = write_npz(tmp_path / "a.npz", {**smplx, "f": faces})
    with pytest.raises(ValueError, match=r"a\.npz: f holds 70, expected 0 to 69"):
        load_body(path)
    path = write_npz(tmp_path / "b.npz", {**smplx, "part_labels": np.full(70, 5)})
    with pytest.raises(ValueError, match=r"b\.npz: part_labels holds 5, expected 0 to 4"):
        load_body(path)
    table = smplx["kintree_table"].copy()
    table[0, 10] = 30
    path = write_npz(tmp_path / "c.npz", {**smplx, "kintree_table": table})
    with pytest.raises(ValueError, match=r"c\.npz: kintree_table: joint 10 .* has parent 30"):
        load_body(path)


def test_labels_and_colours_of_the_file(tmp_path, smplx, rng):
    labels, colors = rng.integers(0, 5, 70), rng.integers(0, 255, (70, 3)).astype(np.uint8)
    path = write_npz(tmp_path / "a.npz", {**smplx, "part_labels": labels, "vertex_colors": colors})
    body = load_body(path)
    np.testing.assert_array_equal(body.part_labels, labels)
    np.testing.assert_array_equal(body.colors, colors)


def test_other_kinds_of_file(tmp_path):
    for name in ("model.obj", "model"):
        (tmp_path / name).write_text("v 0 0 0")
        with pytest.raises(ValueError, match=r"an \.npz or \.pkl file"):
            load_body(tmp_path / name)
    (tmp_path / "list.pkl").write_bytes(pickle.dumps([1, 2], 2))
    with pytest.raises(ValueError, match=r"list\.pkl: expected a dictionary of arrays, found list"):
        load_body(tmp_path / "list.pkl")
    (tmp_path / "text.npz").write_text("not an archive")
    with pytest.raises(ValueError, match=r"text\.npz: not a readable"):
        load_body(tmp_path / "text.npz")


class Attack:
    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.system, (f"touch {self.marker}",)


@pytest.mark.parametrize("suffix", ["pkl", "npz"])
def test_a_malicious_model_is_refused(tmp_path, smplx, suffix):
    marker, path = tmp_path / "ran", tmp_path / f"model.{suffix}"
    if suffix == "pkl":
        path.write_bytes(pickle.dumps({**smplx, "v_template": Attack(marker)}, 2))
    else:
        write_npz(path, {**smplx, "joint2num": np.array({"a": Attack(marker)}, dtype=object)})
    with pytest.raises(UnsafePickleError, match=rf"model\.{suffix}"):
        load_body(path)
    assert not marker.exists()


def test_names_of_another_tree(tmp_path):
    parents, names = (-1, 0, 0), ("base", "up", "down")
    named = toy_arrays(parents, names=names)
    assert load_body(write_npz(tmp_path / "a.npz", named)).tree.names == names
    unnamed = toy_arrays(parents)
    body = load_body(write_npz(tmp_path / "b.npz", unnamed))
    assert body.tree.names == ("joint0", "joint1", "joint2")
    assert not np.asarray(body.part_labels).any()


def test_the_side_of_a_mano_hand(tmp_path):
    arrays = toy_arrays(PARENTS["mano"])
    for side in ("left", "right"):
        body = load_body(write_npz(tmp_path / f"MANO_{side.upper()}.npz", arrays))
        assert body.tree.names[0] == f"{side}_wrist"


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("v_template", lambda a: a + 0j, "v_template has the type complex128, expected real"),
        ("v_template", lambda a: a.astype(str), "v_template has the type <U32, expected real"),
        (
            "v_template",
            lambda a: 1000 * a,
            "v_template extends over 15.*expected 0.02 to 10 metres",
        ),
        ("v_template", lambda a: 100 * a, "v_template extends over 15.*expected 0.02 to 10 metres"),
        ("v_template", lambda a: 1e200 * a, "v_template has entries as large as .*e\\+199"),
        ("v_template", lambda a: 0 * a, "v_template extends over 0, expected 0.02 to 10 metres"),
        ("v_template", lambda a: a * [1, 0, 0], "triangles in f have an area of 0 square metres"),
        ("v_template", lambda a: np.full(a.shape, None), "v_template has the type object"),
        ("f", lambda a: np.where(a == 3, np.nan, a), "f has entries that are not finite"),
        ("f", lambda a: a + 0.5, "f holds .*5, expected whole numbers"),
        ("f", lambda a: a - 70, "f holds -[1-9].*, expected 0 to 69"),
        ("f", lambda a: 0 * a, "the 40 triangles in f have an area of 0 square metres"),
        ("f", lambda a: a[:0], "the 0 triangles in f have an area of 0 square metres"),
        (
            "J_regressor",
            lambda a: 0.5 * a,
            r"row \d+ of J_regressor \(\w+\) sums to 0.5, expected 1",
        ),
        ("J_regressor", lambda a: 0 * a, r"row 0 of J_regressor \(pelvis\) sums to 0, expected 1"),
        ("shapedirs", lambda a: 1e200 * a, "shapedirs has entries as large as"),
        ("posedirs", lambda a: a * 1j, "posedirs has the type complex128"),
        ("weights", lambda a: a.astype(object), "weights has the type object, expected real"),
        ("kintree_table", lambda a: a + 0.25, "kintree_table holds .*, expected whole numbers"),
        ("hands_meanl", lambda a: np.full(45, 1e300), "hands_meanl has entries as large as 1e"),
    ],
)
@pytest.mark.parametrize("suffix", ["npz", "pkl"])
def test_values_that_are_no_body_are_refused(tmp_path, smplx, key, change, message, suffix):
    path = tmp_path / f"a.{suffix}"
    changed = {**smplx, key: change(smplx[key])}
    if suffix == "npz":
        np.savez(path, **changed)
    else:
        path.write_bytes(pickle.dumps(changed, 2))
    with pytest.raises(ValueError, match=message) as error:
        load_body(path)
    assert str(path) in str(error.value)


def test_an_entry_that_is_none_counts_as_missing(tmp_path, smplx):
    (tmp_path / "a.pkl").write_bytes(pickle.dumps({**smplx, "weights": None}, 2))
    with pytest.raises(ValueError, match=r"a\.pkl: no entry 'weights'; the file has"):
        load_body(tmp_path / "a.pkl")


def test_lists_of_different_lengths_name_the_file(tmp_path, smplx):
    (tmp_path / "a.pkl").write_bytes(pickle.dumps({**smplx, "f": [[0, 1, 2], [3, 4]]}, 2))
    with pytest.raises(ValueError, match=r"a\.pkl: f is not an array of numbers"):
        load_body(tmp_path / "a.pkl")


@pytest.mark.parametrize("columns", [300, 150, 40])
def test_shape_columns_without_expression(tmp_path, columns):
    """All are shape, with a warning, unless the caller asks for no expression."""
    arrays = toy_arrays(PARENTS["smplx"], columns=columns)
    path = write_npz(tmp_path / "a.npz", arrays)
    message = rf"a\.npz: shapedirs has {columns} columns, expected 400 or 20"
    with pytest.warns(UserWarning, match=message):
        body = load_body(path)
    assert (body.num_betas, body.num_expression) == (columns, 0)
    np.testing.assert_allclose(body.shape_dirs, arrays["shapedirs"], rtol=1e-6)
    with (
        pytest.warns(UserWarning, match=message),
        pytest.raises(ValueError, match="the file has 0"),
    ):
        load_body(path, num_betas=10, num_expression=10)
    assert load_body(path, num_betas=10, num_expression=0).num_betas == 10  # no warning


@pytest.mark.parametrize(
    ("name", "gender"),
    [
        ("smplh/male/model.npz", "male"),
        ("smplh/female/model.npz", "female"),
        ("smpl/basicmodel_f_lbs_10_207_0_v1.1.0.npz", "female"),
        ("smpl/basicModel_m_lbs_10_207_0_v1.0.0.npz", "male"),
        ("smpl/basicmodel_neutral_lbs_10_207_0_v1.1.0.npz", "neutral"),
        ("male/SMPLX_FEMALE.npz", "female"),
        ("f/m_model.npz", "neutral"),
        ("other/smplx-male-2020.npz", "male"),
    ],
)
def test_gender_from_published_names(tmp_path, smplx, name, gender):
    assert load_body(write_npz(tmp_path / name, smplx)).source.gender == gender


@pytest.mark.parametrize(
    ("name", "gender"),
    [
        ("smplx/male/model.npz", "male"),
        ("female/model.npz", "female"),
        ("smplx/basicmodel_f_lbs_10_207_0_v1.1.0.npz", "female"),
        ("basicModel_neutral_lbs_10_207_0_v1.0.0.npz", "neutral"),
    ],
)
def test_published_names_are_found_in_a_folder(tmp_path, smplx, name, gender):
    path = write_npz(tmp_path / name, smplx)
    body = load_body(tmp_path, gender=gender)
    assert (body.source.path, body.source.gender) == (str(path), gender)
    other = "male" if gender != "male" else "female"
    with pytest.raises(FileNotFoundError, match="no body model found"):
        load_body(tmp_path, gender=other)
