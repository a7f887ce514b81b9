"""Frames from mesh files with a file of parameters for each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..body import HANDS, BodyModel, BodyParams, hands_to_relative, pose_groups
from ..files.meshes import read_mesh
from ..frames import Frames, nearest_part_labels, posed_vertices
from .capture import one_shape
from .frame_params import read_frame_params, stack_params

MAX_MISMATCH_M = 0.10  # median distance of a mesh from the body posed like it
_SAME_VERTICES_M = 0.01


def read_params(
    pairs: Sequence[tuple[Path, Path]],
    body: BodyModel,
    *,
    betas: np.ndarray | None,
    flat_hand_mean: bool,
    verbose: bool,
) -> tuple[BodyParams, np.ndarray, list[str]]:
    """Parameters of every frame, the subject's shape, and notices.

    Args:
        pairs: mesh and parameter file of each frame.
        body: the body the parameters are for.
        betas: the subject's shape; None takes the one the files agree on, or their mean.
        flat_hand_mean: whether hands are absolute in files that do not say.
        verbose: show a progress bar.
    """
    from tqdm.auto import tqdm

    paths = [params for _, params in pairs]
    bar = tqdm(paths, desc="reading parameters", unit="file", disable=None if verbose else True)
    frames = [read_frame_params(path, body) for path in bar]
    notices = []
    if betas is None:
        given = {str(p): f["betas"] for p, f in zip(paths, frames, strict=True) if "betas" in f}
        betas, notice = one_shape(given) if given else (np.zeros(0), None)
        if not given:
            notice = f"{paths[0].parent}: no betas in the parameters: the mean shape is used."
        notices += [notice] if notice else []
    expression = max((f["expression"].size for f in frames if "expression" in f), default=0)
    for name, most, known in (
        ("betas", len(betas), body.num_betas),
        ("expression", expression, body.num_expression),
    ):
        if most > known:
            notices.append(f"{paths[0].parent}: {most} {name} given, the body has {known}.")
    params = stack_params(frames, paths, body, betas, flat_hand_mean=flat_hand_mean)
    return params, betas, notices


def mesh_frames(
    pairs: Sequence[tuple[Path, Path]],
    sequences: Sequence[str],
    params: BodyParams,
    body: BodyModel,
) -> Frames:
    """Frames read from mesh files when asked for, labelled by the body in the same pose.

    Args:
        pairs: mesh and parameter file of each frame.
        sequences: sequence name of each frame.
        params: batched parameters.
        body: gives the labels.
    """
    names = list(dict.fromkeys(sequences))
    meshes = [mesh for mesh, _ in pairs]

    def labels(i: int) -> np.ndarray:
        # Read again rather than kept: a frame is asked for once, and memory must not grow.
        return part_labels(body, params[i], read_mesh(meshes[i])[0])

    return Frames(
        params,
        lambda i: read_mesh(meshes[i]),
        part_labels=labels,
        sources=[str(mesh) for mesh in meshes],
        body=body,
        sequence_names=names,
        sequence_index=np.array([names.index(s) for s in sequences]),
    )


def part_labels(body: BodyModel, params: BodyParams, vertices: np.ndarray) -> np.ndarray:
    """The body's own labels for a mesh with the body's vertices, else those of the nearest."""
    if len(vertices) == body.num_vertices:
        distance = np.linalg.norm(posed_vertices(body, params) - vertices, axis=1)
        if np.median(distance) < _SAME_VERTICES_M:
            return np.asarray(body.part_labels, np.int8)
    return nearest_part_labels(body, params, vertices)


def check_first_frame(frames: Frames, body: BodyModel, *, flat_hand_mean: bool) -> list[str]:
    """Compare the first mesh with the body in its pose: wrong units, axes and hands show at once.

    Returns:
        A notice if the hands would fit better under the other convention.

    Raises:
        ValueError: mesh and body are more than `MAX_MISMATCH_M` apart.
    """
    from scipy.spatial import cKDTree

    frame = frames[0]
    posed = posed_vertices(body, frame.params)
    tree = cKDTree(frame.vertices)
    distance = tree.query(posed)[0]
    if np.median(distance) > MAX_MISMATCH_M:
        size = np.ptp(frame.vertices, axis=0).max()
        raise ValueError(
            f"{frame.source}: mesh and parameters do not belong together: half of the posed body "
            f"is more than {np.median(distance):.2f} m away from the mesh, which is {size:.3g} m "
            "large. Check units (metres), axes (the mesh must be in the world of the parameters) "
            "and transl."
        )
    hands = np.isin(body.part_labels, HANDS)
    if not hands.any() or not np.any(np.asarray(body.hand_mean)):
        return []
    other = tree.query(posed_vertices(body, _other_hands(body, frame.params, flat_hand_mean)))[0]
    mine, theirs = (float(np.mean(d[hands])) for d in (distance, other))
    if theirs < 0.5 * mine and mine - theirs > 1e-3:
        return [
            f"{frame.source}: the hands lie {1e3 * mine:.1f} mm from the mesh, and would lie "
            f"{1e3 * theirs:.1f} mm away with flat_hand_mean={not flat_hand_mean}: "
            "is the mean hand added twice, or missing?"
        ]
    return []


def _other_hands(body: BodyModel, params: BodyParams, flat_hand_mean: bool) -> BodyParams:
    pose = params.pose
    for side in ("left", "right"):
        joints = np.array(pose_groups(body.tree)[f"{side}_hand_pose"], dtype=int)
        if not len(joints):
            continue
        hand = pose[joints]
        relative = hands_to_relative(body, hand, side)
        pose = pose.at[joints].set(2 * hand - relative if flat_hand_mean else relative)
    return replace(params, pose=pose)
