"""Which joint of a skeleton is which joint of SMPL-X: known namings, and names read as words."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from ..body import SMPLX_TREE, pose_groups
from ..files import load_json

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
# Without these, neither the person's position nor the pose of the limbs is known.
NEEDED = (
    "pelvis", "head", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle",
    "right_ankle", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist",
    "right_wrist",
)  # fmt: skip


def match_joints(
    names: Sequence[str],
    joint_map: str | Path | Mapping[str, str] | None,
    where: str,
    parents: Sequence[int] | None = None,
) -> tuple[str, dict[str, int]]:
    """Name of the map used, and the file's joint for each SMPL-X joint that it has.

    Args:
        names: of the file's joints.
        joint_map: a key of `JOINT_MAPS`; a mapping from names of the file to names of SMPL-X, or
            the path of a JSON file with one; or None for the known naming that fits most joints
            of the body and, if none has all that are needed, for the names read as words.
        where: file, for messages.
        parents: of the joints. Words are ambiguous without their position in the chain.

    Raises:
        ValueError: no such map, names that do not exist, or joints that are needed are missing.
    """
    short = [_without_prefix(name) for name in names]
    if joint_map is None:
        # Joints of the body decide, since several kinds of file share names of fingers. The first
        # of equals wins.
        def fit(title: str) -> int:
            return sum(JOINT_MAPS[title].get(name) in _BODY_JOINTS for name in short)

        title = max(JOINT_MAPS, key=fit)
        found = _by_table(JOINT_MAPS[title], names, short)
        if parents is not None and any(name not in found for name in NEEDED):
            words = _by_words(names, parents)
            if _lacking(words) < _lacking(found):
                title, found = "words", words
    else:
        title, chosen = _chosen(joint_map, names, short, where)
        found = _by_table(chosen, names, short)
    missing = [name for name in NEEDED if name not in found]
    if missing:
        listed = ", ".join(names[:60]) + (", ..." if len(names) > 60 else "")
        raise ValueError(
            f"{where}: no joint for {', '.join(missing)}. Looked for the names of the map "
            f"{title!r}; the file has {listed}. Pass joint_map={{name in the file: name "
            "of SMPL-X}, or a JSON file with such a mapping (--joint-map FILE)."
        )
    return title, found


def _lacking(found: Mapping[str, int]) -> int:
    return sum(name not in found for name in NEEDED)


def _chosen(
    joint_map: str | Path | Mapping[str, str], names: Sequence[str], short: list[str], where: str
) -> tuple[str, Mapping[str, str]]:
    """A map by its name, from a file, or as given."""
    if isinstance(joint_map, str) and joint_map in JOINT_MAPS:
        return joint_map, JOINT_MAPS[joint_map]
    title = "given"
    if isinstance(joint_map, (str, Path)):
        file = Path(joint_map).expanduser()
        if not file.is_file():
            raise ValueError(
                f"No joint map {str(joint_map)!r}; there are {', '.join(JOINT_MAPS)}, and no such "
                "file."
            )
        title, joint_map = str(file), load_json(file)
    if not isinstance(joint_map, Mapping) or not all(
        isinstance(text, str) for pair in joint_map.items() for text in pair
    ):
        raise ValueError(
            f"{where}: joint map {title!r} is no mapping from names of the file to names of SMPL-X."
        )
    unknown = [n for n in joint_map if n not in names and n not in short]
    if unknown:
        raise ValueError(f"{where}: joint_map names {', '.join(unknown)}, which are not in it.")
    foreign = [n for n in joint_map.values() if n not in SMPLX_TREE.names]
    if foreign:
        raise ValueError(f"{where}: joint_map leads to {', '.join(foreign)}, not joints of SMPL-X.")
    return title, joint_map


def _by_table(chosen: Mapping[str, str], names: Sequence[str], short: list[str]) -> dict[str, int]:
    found: dict[str, int] = {}
    for index, (name, plain) in enumerate(zip(names, short, strict=True)):
        target = chosen.get(name, chosen.get(plain))
        if target is not None:
            found.setdefault(target, index)
    return found


def _without_prefix(name: str) -> str:
    """A name without the prefix of its exporter: `mixamorig:Hips`, `m_avg_Pelvis`."""
    short = name.split(":")[-1]
    for prefix in ("mixamorig_", "m_avg_", "f_avg_"):
        short = short.removeprefix(prefix)
    return short


# Names as words

_SIDES = {
    "left": "left", "l": "left", "lft": "left", "lt": "left",
    "right": "right", "r": "right", "rgt": "right", "rt": "right",
}  # fmt: skip
# Joints that help an animator or end a chain.
_HELPERS = {
    "twist", "roll", "ik", "fk", "end", "nub", "site", "tip", "pole", "helper", "prop", "target",
    "metacarpal", "socket", "weapon", "effector", "ctrl", "control", "aux",
}  # fmt: skip
# How well a word names each joint of a chain, from the trunk outwards. Where words are ambiguous
# (a "foot" below an "ankle" is the toe joint), the order along the chain decides.
_CHAINS: dict[str, dict[str, dict[str, float]]] = {
    "leg": {
        "hip": {"thigh": 3, "upleg": 3, "upperleg": 3, "legupper": 3, "femur": 3, "hip": 3,
                "hipjoint": 1, "leg": 1},
        "knee": {"knee": 3, "calf": 3, "shin": 3, "lowerleg": 3, "lowleg": 3, "leglower": 3,
                 "tibia": 3, "leg": 2},
        "ankle": {"ankle": 3, "foot": 2.5, "heel": 1},
        "foot": {"toe": 3, "toes": 3, "toebase": 3, "ball": 3, "forefoot": 3, "foot": 2},
    },
    "arm": {
        "collar": {"collar": 3, "clavicle": 3, "clav": 3, "scapula": 2, "shoulder": 2},
        "shoulder": {"upperarm": 3, "uparm": 3, "armupper": 3, "humerus": 3, "shldr": 3,
                     "arm": 2.5, "shoulder": 2.2},
        "elbow": {"elbow": 3, "forearm": 3, "lowerarm": 3, "lowarm": 3, "armlower": 3,
                  "radius": 3, "arm": 1},
        "wrist": {"wrist": 3, "hand": 2.9},
    },
}  # fmt: skip
_FINGER_WORDS = {
    "index": "index", "middle": "middle", "mid": "middle", "pinky": "pinky", "little": "pinky",
    "ring": "ring", "thumb": "thumb",
}  # fmt: skip


def _words(name: str) -> list[str]:
    """Lower-case words and numbers of a name: `CC_Base_L_UpLeg01` is cc base l up leg 01."""
    spaced = re.sub(r"([a-z])([A-Z])|([A-Z])([A-Z][a-z])", r"\1\3 \2\4", name)
    return [w for part in re.findall(r"[A-Za-z]+|\d+", spaced) for w in _split_side(part.lower())]


def _split_side(word: str) -> list[str]:
    for side in ("left", "right"):
        if word.startswith(side) and word != side:
            return [side, word.removeprefix(side)]
        if word.endswith(side) and word != side:
            return [word.removesuffix(side), side]
    return [word]


def _by_words(names: Sequence[str], parents: Sequence[int]) -> dict[str, int]:
    """Joints of SMPL-X by the words in the names and the position in the tree."""
    words = [_words(name) for name in names]
    # Words that every joint shares say nothing: the name of a character or program.
    shared = set.intersection(*map(set, words)) if len(words) > 2 else set()
    sides, keys = [], []
    for listed in words:
        listed = [w for w in listed if w not in shared]
        side = next((_SIDES[w] for w in listed if w in _SIDES), "")
        rest = [w for w in listed if w not in _SIDES and not w.isdigit()]
        helper = bool(_HELPERS & set(rest))
        sides.append("" if helper else side)
        keys.append([] if helper else rest)
    found: dict[str, int] = {}
    for side in ("left", "right"):
        members = [j for j in range(len(names)) if sides[j] == side]
        for joints in _CHAINS.values():
            found |= {f"{side}_{n}": j for n, j in _chain(joints, members, keys, parents).items()}
    if {"left_hip", "right_hip"} <= found.keys():
        pelvis = _common(found["left_hip"], found["right_hip"], parents)
        if pelvis is not None:
            found["pelvis"] = pelvis
            found |= _trunk(found, keys, sides, parents)
    found |= _fingers(found, words, sides, keys, parents)
    return found


def _chain(
    joints: dict[str, dict[str, float]],
    members: list[int],
    keys: list[list[str]],
    parents: Sequence[int],
) -> dict[str, int]:
    """The best assignment of joints along one path of the tree, in the order of the chain."""
    order = list(joints)

    def weight(member: int, name: str) -> float:
        listed = keys[member]
        compounds = {"".join(listed[k:]) for k in range(len(listed))} | {
            "".join(listed[:k]) for k in range(1, len(listed) + 1)
        }
        return max((joints[name].get(word, 0) for word in compounds), default=0)

    weights = {m: [weight(m, name) for name in order] for m in members}
    members = [m for m in members if max(weights[m]) > 0]
    # For each joint taken as the k-th of the chain: total weight, and the one before it.
    best: dict[tuple[int, int], tuple[float, tuple[int, int] | None]] = {}
    for member in members:  # parents come before children
        above = set(_path(member, parents)[1:])
        for k in range(len(order)):
            if not weights[member][k]:
                continue
            before = max(
                (key for key in best if key[0] in above and key[1] < k),
                key=lambda key: best[key][0],
                default=None,
            )
            total = weights[member][k] + (best[before][0] if before else 0)
            best[member, k] = total, before
    if not best:
        return {}
    step: tuple[int, int] | None = max(best, key=lambda key: best[key][0])
    found = {}
    while step is not None:
        found[order[step[1]]] = step[0]
        step = best[step][1]
    return found


def _trunk(
    found: dict[str, int], keys: list[list[str]], sides: list[str], parents: Sequence[int]
) -> dict[str, int]:
    """Spine, neck and head, from where arms, legs and the head meet."""
    tops = [found.get(f"{s}_collar", found.get(f"{s}_shoulder")) for s in ("left", "right")]
    if tops[0] is None or tops[1] is None:
        return {}
    chest = _common(tops[0], tops[1], parents)
    if chest is None:
        return {}
    trunk = {}
    spine = [j for j in reversed(_path(chest, parents)) if found["pelvis"] in _path(j, parents)[1:]]
    spine = [j for j in spine if keys[j]]
    names = {1: ["spine3"], 2: ["spine1", "spine3"]}.get(len(spine), ["spine1", "spine2", "spine3"])
    if len(spine) > 3:
        spine = [spine[0], spine[len(spine) // 2], spine[-1]]
    trunk |= dict(zip(names, spine, strict=False))
    above = [
        j for j in range(len(keys))
        if not sides[j] and keys[j] and chest in _path(j, parents)[1:]
    ]  # fmt: skip
    heads = [j for j in above if any(w.startswith("head") for w in keys[j])]
    necks = [j for j in above if any(w.startswith("neck") for w in keys[j])]
    if heads:
        trunk["head"] = heads[0]
        necks = [j for j in necks if j in _path(heads[0], parents)[1:]]
    elif len(necks) > 1:
        trunk["head"] = necks.pop()
    if necks:
        trunk["neck"] = necks[0]
    return trunk


def _fingers(
    found: dict[str, int],
    words: list[list[str]],
    sides: list[str],
    keys: list[list[str]],
    parents: Sequence[int],
) -> dict[str, int]:
    """Joints of fingers below the wrists, counted along each finger."""
    fingers: dict[str, int] = {}
    for side in ("left", "right"):
        wrist = found.get(f"{side}_wrist")
        if wrist is None:
            continue
        chains: dict[str, list[int]] = {}
        for j in range(len(words)):
            if sides[j] in ("", side) and keys[j] and wrist in _path(j, parents)[1:]:
                finger = next((_FINGER_WORDS[w] for w in keys[j] if w in _FINGER_WORDS), None)
                if finger:
                    chains.setdefault(finger, []).append(j)
        for finger, joints in chains.items():
            # A fourth joint is the bone in the palm, or the tip.
            numbered = [j for j in joints if words[j][-1:] != ["0"]] if len(joints) > 3 else joints
            fingers |= {f"{side}_{finger}{k}": j for k, j in enumerate(numbered[:3], start=1)}
    return fingers


def _path(joint: int, parents: Sequence[int]) -> list[int]:
    """A joint and its ancestors, up to the root."""
    path = [joint]
    while parents[path[-1]] >= 0:
        path.append(parents[path[-1]])
    return path


def _common(one: int, other: int, parents: Sequence[int]) -> int | None:
    """The lowest joint above both."""
    above = set(_path(other, parents)[1:])
    return next((j for j in _path(one, parents)[1:] if j in above), None)
