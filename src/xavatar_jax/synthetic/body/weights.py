"""Skinning weights: a segmentation by joint, diffused over the surface.

Planes across the limbs assign each vertex to one joint. The labels are then diffused along the
surface (a few implicit heat steps) over a width that depends on the thickness of the part. So
transitions are about as long as the limb is thick, do not cross gaps (lips, fingers, armpits), and
weights sum to one by construction.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from .head import EYE, EYE_RADIUS, lid_opening, mouth_line
from .sizing import edge_length
from .skeleton import (
    FINGERS,
    JOINT_INDEX,
    JOINT_NAMES,
    finger_chain,
    mirrored_joint,
    rest_joints,
)

# Standard deviation of the diffusion in metres, by joint (sides alike).
_WIDTHS = {
    "pelvis": 0.042, "spine1": 0.042, "spine2": 0.042, "spine3": 0.040, "hip": 0.038,
    "knee": 0.030, "ankle": 0.020, "foot": 0.017, "neck": 0.030, "head": 0.022, "jaw": 0.0100,
    "eye": 0.0008, "collar": 0.034, "shoulder": 0.028, "elbow": 0.025, "wrist": 0.013,
    "index": 0.0057, "middle": 0.0057, "ring": 0.0055, "pinky": 0.0050, "thumb": 0.0066,
}  # fmt: skip
_STEPS = 4
_DROP = 5e-4


def _left(p: np.ndarray) -> np.ndarray:
    """Joint of points with x >= 0, as indices (midline and left joints)."""
    x, y, z = p.T
    j = rest_joints()
    name = np.full(len(p), JOINT_INDEX["spine3"])

    def put(where: np.ndarray, joint: str) -> None:
        name[where] = JOINT_INDEX[joint]

    put(y < -0.030, "spine2")
    put(y < -0.170, "spine1")
    put(y < -0.290, "pelvis")
    # The groin rises outwards to the hip bone.
    leg = y < -0.505 + 0.75 * (x - 0.02)
    put(leg & (y < -0.37), "left_hip")
    knee, ankle, foot = j[4], j[7], j[10]
    put(y < knee[1], "left_knee")
    put(y < ankle[1] + 0.012 - 0.25 * (z - ankle[2]), "left_ankle")
    put((y < -1.2) & (z > foot[2] + 0.35 * (0.112 - x)), "left_foot")

    girdle = (y > 0.050 - 0.25 * (x - 0.05)) & (x > 0.042)
    put(girdle, "left_collar")
    arm = (x > 0.160 + 0.25 * (0.10 - y)) & (y > -0.02)
    put(arm, "left_shoulder")
    put(x > j[18][0], "left_elbow")
    put(x > j[20][0], "left_wrist")

    trunk_top = (x < 0.085) & (y > 0.10)
    put(trunk_top & (y + 0.33 * z > 0.128 + 0.35 * np.maximum(x - 0.052, 0.0)), "neck")
    head = (x < 0.12) & (y + 0.45 * z > 0.236)
    put(head, "head")
    jaw = head & (z > 0.004) & (y < 0.262 + 0.06 * (z - 0.085))
    # In front the mouth line is the border; the floor of the mouth follows the jaw.
    front = head & (z > 0.045) & (x < 0.030)
    jaw = np.where(front, y < mouth_line(x), jaw)
    put(jaw, "jaw")
    ball = np.linalg.norm(p - EYE, axis=1) < EYE_RADIUS + 0.0005
    put(ball & (lid_opening(p) < -0.0002) & (z > EYE[2]), "left_eye")

    hand = np.flatnonzero(x > j[20][0])
    if hand.size:
        name[hand] = _hand(p[hand])
    return name


def _segment_distance(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    axis = b - a
    t = (p - a) @ axis / (axis @ axis)
    near = a + np.clip(t, 0.0, 1.0)[:, None] * axis
    return np.linalg.norm(p - near, axis=1), t


def _hand(p: np.ndarray) -> np.ndarray:
    wrist = rest_joints()[JOINT_INDEX["left_wrist"]]
    name = np.full(len(p), JOINT_INDEX["left_wrist"])
    best = np.full(len(p), np.inf)
    for finger in FINGERS:
        chain = finger_chain(finger)
        if finger == "thumb":
            palm = np.full(len(p), np.inf)
            for other in ("index", "middle"):
                knuckle = finger_chain(other)[0]
                start = wrist + (knuckle - wrist) * 0.15
                palm = np.minimum(palm, _segment_distance(p, start, knuckle)[0])
        for i in range(3):
            distance, t = _segment_distance(p, chain[i], chain[i + 1])
            begins = 0.0
            if finger == "thumb" and i == 0:
                # The ball of the thumb borders the palm: points nearer to the palm stay with it.
                distance = np.where(distance < palm + 0.002, distance, np.inf)
                begins = 0.18
            take = (t > begins) & (distance < best)
            name[take] = JOINT_INDEX[f"left_{finger}{i + 1}"]
            best[take] = distance[take]
    return name


def segment(points: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, " N"]:
    """The joint each point of the surface belongs to before diffusion."""
    p = np.array(points, dtype=np.float64)
    right = p[:, 0] < 0.0
    p[:, 0] = np.abs(p[:, 0])
    left = _left(p)
    mirror = np.array([mirrored_joint(i) for i in range(len(JOINT_NAMES))])
    return np.where(right, mirror[left], left)


def _width_of(joint: int) -> float:
    name = JOINT_NAMES[joint].split("_")[-1]
    return _WIDTHS.get(name, _WIDTHS.get(name.rstrip("123"), 0.03))


def surface_operators(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> tuple:  # two sparse matrices
    """Cotangent Laplacian with negative weights dropped (positive semidefinite) and areas."""
    import igl
    from scipy.sparse import diags

    cot = igl.cotmatrix(vertices, faces.astype(np.int64)).tocsr()
    cot.setdiag(0.0)
    cot.data = np.maximum(cot.data, 0.0)
    laplacian = diags(np.asarray(cot.sum(1)).ravel()) - cot
    mass = igl.massmatrix(vertices, faces.astype(np.int64), igl.MASSMATRIX_TYPE_BARYCENTRIC)
    return laplacian.tocsc(), mass.tocsc()


def diffuse(
    values: Float[np.ndarray, "V K"],
    width: Float[np.ndarray, " V"],
    operators: tuple,
    steps: int = _STEPS,
) -> Float[np.ndarray, "V K"]:
    """Implicit heat steps along the surface; `width` approximates the standard deviation."""
    from scipy.sparse import diags
    from scipy.sparse.linalg import splu

    laplacian, mass = operators
    area = mass.diagonal()
    scaled = area / (0.5 * width**2 / steps)
    system = splu(
        (diags(scaled) + laplacian).tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    # Diffusion preserves constants. This offset avoids denormal numbers in the far tails, which
    # are many times slower.
    lift = 1e-3
    values = values + lift
    for _ in range(steps):
        values = system.solve(scaled[:, None] * values)
    return values - lift


def skinning_weights(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], operators: tuple
) -> Float[np.ndarray, "V 55"]:
    """Smooth weights (V, 55); rows sum to one."""
    label = segment(vertices)
    width = np.array([_width_of(j) for j in range(len(JOINT_NAMES))])[label]
    # A transition cannot be sharper than the mesh, except at the rims of the eyelids.
    edge = edge_length(vertices)
    width = np.where(edge > 0.003, np.maximum(width, 1.1 * edge), width)
    # Smooth the width, whose jumps would show in the weights.
    for _ in range(2):
        width = np.exp(diffuse(np.log(width)[:, None], 0.5 * width, operators, steps=1)[:, 0])
    hard = np.zeros((len(vertices), len(JOINT_NAMES)))
    hard[np.arange(len(vertices)), label] = 1.0
    weights = diffuse(hard, width, operators)
    weights = np.where(weights < _DROP, 0.0, weights)
    return weights / weights.sum(1, keepdims=True)
