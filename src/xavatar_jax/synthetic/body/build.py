"""Build the bundled body in the SMPL-X v1.1 layout, and cache it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from ...body import BodyModel, load_body
from ...files import atomic_path, cache_path, cached
from .anatomy import BODY_BOX, Person
from .colors import synthetic_colors
from .correctives import pose_directions
from .expression import expression_directions
from .hands import hand_basis, mirror_rotation, relaxed_hand
from .labels import part_labels
from .landmarks import landmarks
from .octree import extract
from .regressor import joint_regressor
from .remesh import remesh
from .shape import shape_directions
from .sizing import edge_length, leaf_size, longest_edge
from .skeleton import JOINT_NAMES, PARENTS
from .topology import vertex_normals
from .untangle import untangle
from .weights import skinning_weights, surface_operators

# The key of the cache entry. Change it whenever the arrays change.
SYNTHETIC_BODY_VERSION = "5"
"""Version of the bundled body. It changes whenever the generated arrays do."""

_NUM_SHAPE, _NUM_EXPRESSION = 300, 100


def build_synthetic_body(*, verbose: bool = False) -> dict[str, np.ndarray]:
    """The arrays of an SMPL-X v1.1 file of a generated person.

    Deterministic. Keys: v_template (V, 3) metres, f (F, 3) uint32, shapedirs (V, 3, 400) with
    shape in columns 0 to 299 and expression from 300 (ten of each used), posedirs (V, 3, 486),
    J_regressor (55, V), weights (V, 55), kintree_table (2, 55), joint2num (object array of one
    dict), hands_meanl/r (45,), hands_componentsl/r (45, 45), the four landmark arrays, and two
    entries SMPL-X does not have: part_labels (V,) int8 and vertex_colors (V, 3) uint8.
    `verbose` shows a progress bar.
    """
    from tqdm.auto import tqdm

    with tqdm(total=5, desc="bundled body", disable=None if verbose else True) as bar:
        return _build(bar)


def _build(bar: Any) -> dict[str, np.ndarray]:
    person = Person()
    vertices, faces = extract(person, leaf_size, BODY_BOX)
    bar.update()
    vertices, faces = remesh(person, vertices, faces, edge_length, longest_edge)
    bar.update()
    # The stored float32 positions are the body; everything else is derived from them.
    vertices = untangle(vertices.astype(np.float32).astype(np.float64), faces)
    vertices = vertices.astype(np.float32).astype(np.float64)
    bar.update()
    normals = vertex_normals(vertices, faces)
    weights = skinning_weights(vertices, faces, surface_operators(vertices, faces))
    bar.update()

    shape, joint_shape = shape_directions(vertices, normals, weights)
    expression = expression_directions(vertices, weights)
    shapedirs = np.zeros((len(vertices), 3, _NUM_SHAPE + _NUM_EXPRESSION), dtype=np.float32)
    shapedirs[..., : shape.shape[-1]] = shape
    shapedirs[..., _NUM_SHAPE : _NUM_SHAPE + expression.shape[-1]] = expression
    moves = np.abs(expression).max((1, 2)) > 1e-4
    regressor = joint_regressor(vertices, moves.astype(float), shape, joint_shape)

    joint2num = np.empty((), dtype=object)
    joint2num[()] = {name: i for i, name in enumerate(JOINT_NAMES)}
    parents = np.asarray(PARENTS, dtype=np.int64)
    mean = relaxed_hand()
    basis = hand_basis()
    bar.update()
    return {
        "v_template": vertices.astype(np.float32),
        "f": faces.astype(np.uint32),
        "shapedirs": shapedirs,
        "posedirs": pose_directions(vertices, normals),
        "J_regressor": regressor.astype(np.float32),
        "weights": weights.astype(np.float32),
        # As in SMPL-X files, the root's parent is the largest 32-bit number.
        "kintree_table": np.stack(
            [np.where(parents < 0, 2**32 - 1, parents), np.arange(len(parents))]
        ),
        "joint2num": joint2num,
        "hands_meanl": mean,
        "hands_meanr": mirror_rotation(mean.reshape(15, 3)).ravel(),
        "hands_componentsl": basis,
        "hands_componentsr": mirror_rotation(basis.reshape(45, 15, 3)).reshape(45, 45),
        **landmarks(vertices, faces),
        "part_labels": part_labels(vertices),
        "vertex_colors": synthetic_colors(vertices),
    }


def write_synthetic_body(path: str | Path, *, verbose: bool = False) -> Path:
    """Build the body and write it as a compressed `.npz`, atomically.

    **Raises:** `OSError` if the folder cannot be written to.
    """
    path = Path(path)
    arrays = build_synthetic_body(verbose=verbose)
    # Through an open file, because NumPy would append a suffix to the temporary name.
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **arrays)  # pyright: ignore[reportArgumentType]
    return path


def synthetic_body(cache: str | os.PathLike[str] | None = None) -> BodyModel:
    """The bundled body: built on first use (under a minute), then read from the cache folder.

    It has the SMPL-X tree, ten shape and ten expression directions, and this project's licence.
    A damaged cache entry is built again, with a `CacheNotice`. `cache` overrides the user's cache
    folder.
    """
    return cached(
        cache_path(cache) / f"synthetic_body-{SYNTHETIC_BODY_VERSION}.npz",
        write_synthetic_body,
        lambda path: load_body(path, num_betas=10, num_expression=10),
    )
