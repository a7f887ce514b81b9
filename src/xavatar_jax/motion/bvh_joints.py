"""Which joint of a BVH skeleton is which of SMPL-X, for the namings that are common."""

from __future__ import annotations

from collections.abc import Mapping

from ..body import SMPLX_TREE, pose_groups

_FINGERS = ("Index", "Middle", "Pinky", "Ring", "Thumb")


def _mirrored(names: Mapping[str, str]) -> dict[str, str]:
    """Both sides of names given for the left."""
    right = {
        k.replace("Left", "Right").replace("L_", "R_"): v.replace("left", "right")
        for k, v in names.items()
    }
    return {**names, **right}


_FINGER_NAMES = {
    f"LeftHand{finger}{k}": f"left_{finger.lower()}{k}" for finger in _FINGERS for k in (1, 2, 3)
}
_LIMBS = {
    "LeftUpLeg": "left_hip", "LeftLeg": "left_knee", "LeftFoot": "left_ankle",
    "LeftToeBase": "left_foot", "LeftShoulder": "left_collar", "LeftArm": "left_shoulder",
    "LeftForeArm": "left_elbow", "LeftHand": "left_wrist",
}  # fmt: skip
_SHORT = {
    "L_Hip": "left_hip", "L_Knee": "left_knee", "L_Ankle": "left_ankle", "L_Foot": "left_foot",
    "L_Collar": "left_collar", "L_Shoulder": "left_shoulder", "L_Elbow": "left_elbow",
    "L_Wrist": "left_wrist",
}  # fmt: skip
JOINT_MAPS: dict[str, dict[str, str]] = {
    "smplx": {name: name for name in SMPLX_TREE.names},
    "mixamo": {
        **_mirrored(_LIMBS | _FINGER_NAMES),
        **{"Hips": "pelvis", "Spine": "spine1", "Spine1": "spine2", "Spine2": "spine3"},
        **{"Neck": "neck", "Head": "head"},
    },
    "cmu": {
        **_mirrored(_LIMBS),
        **{"Hips": "pelvis", "LowerBack": "spine1", "Spine": "spine2", "Spine1": "spine3"},
        **{"Neck": "neck", "Head": "head"},
    },
    "smpl": {
        **_mirrored(_SHORT),
        **{"Pelvis": "pelvis", "Spine1": "spine1", "Spine2": "spine2", "Spine3": "spine3"},
        **{"Neck": "neck", "Head": "head"},
    },
}
"""Names in a BVH file, without a prefix such as `mixamorig:`, to names of SMPL-X, by skeleton."""
_GROUPS = pose_groups(SMPLX_TREE)
_BODY_JOINTS = {SMPLX_TREE.names[j] for j in _GROUPS["global_orient"] + _GROUPS["body_pose"]}
# Without these nothing can be said about where the person stands or what the limbs do.
NEEDED = (
    "pelvis", "head", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle",
    "right_ankle", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist",
    "right_wrist",
)  # fmt: skip


def match_joints(
    names: tuple[str, ...], joint_map: str | Mapping[str, str] | None, where: str
) -> tuple[str, dict[str, int]]:
    """Name of the map used, and the file's joint for each SMPL-X joint that it has.

    Args:
        names: of the file's joints.
        joint_map: a key of `JOINT_MAPS`, names of the file to names of SMPL-X, or None to take
            the map that fits most joints of the body.
        where: file, for messages.

    Raises:
        ValueError: no such map, names that do not exist, or joints that are needed are missing.
    """
    plain = [_plain(name) for name in names]
    if joint_map is None:
        # By the joints of the body: several kinds of file share names of fingers. The first of
        # equals wins.
        def fit(title: str) -> int:
            return sum(JOINT_MAPS[title].get(name) in _BODY_JOINTS for name in plain)

        title = max(JOINT_MAPS, key=fit)
        chosen: Mapping[str, str] = JOINT_MAPS[title]
    elif isinstance(joint_map, str):
        if joint_map not in JOINT_MAPS:
            raise ValueError(f"No joint map {joint_map!r}; there are {', '.join(JOINT_MAPS)}.")
        title, chosen = joint_map, JOINT_MAPS[joint_map]
    else:
        title, chosen = "given", joint_map
        _check_given(chosen, names, where)
    found = {}
    for index, (name, short) in enumerate(zip(names, plain, strict=True)):
        target = chosen.get(name, chosen.get(short))
        if target is not None:
            found.setdefault(target, index)
    missing = [name for name in NEEDED if name not in found]
    if missing:
        raise ValueError(
            f"{where}: no joint for {', '.join(missing)}. Looked for the names of the map "
            f"{title!r}; the file has {', '.join(names)}. Pass joint_map={{name in the file: name "
            "of SMPL-X}."
        )
    return title, found


def _plain(name: str) -> str:
    """A name without the prefix of its exporter: `mixamorig:Hips`, `m_avg_Pelvis`."""
    short = name.split(":")[-1]
    for prefix in ("mixamorig_", "m_avg_", "f_avg_"):
        short = short.removeprefix(prefix)
    return short


def _check_given(joint_map: Mapping[str, str], names: tuple[str, ...], where: str) -> None:
    unknown = [n for n in joint_map if n not in names and n not in map(_plain, names)]
    if unknown:
        raise ValueError(f"{where}: joint_map names {', '.join(unknown)}, which are not in it.")
    foreign = [n for n in joint_map.values() if n not in SMPLX_TREE.names]
    if foreign:
        raise ValueError(f"{where}: joint_map leads to {', '.join(foreign)}, not joints of SMPL-X.")
