"""Binary glTF 2.0 with pygltflib: a skinned mesh with blend shapes and animation clips."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import UInt8, UInt16

from .._version import __version__
from ..files import atomic_path
from .rig import Clip, Rig, limit_influences, rotation_quaternions

Color = tuple[float, float, float]
SKIN_COLOR_LINEAR: Color = (0.60, 0.40, 0.30)  # linear light, as in glTF
_TYPES = {"|u1": 5121, "<u2": 5123, "<u4": 5125, "<f4": 5126}
_VERTEX_DATA, _INDEX_DATA = 34962, 34963


def write_glb(
    path: str | os.PathLike[str],
    rig: Rig,
    clips: Sequence[Clip] = (),
    *,
    influences: Literal[4, 8] | int = 4,
    base_color: Color = SKIN_COLOR_LINEAR,
) -> None:
    """Write a rig and its clips as one `.glb` file (glTF 2.0, section 3.7.3 on skins).

    Metres, y up. `influences` is the number of bones per vertex; 8 need a second set of attributes,
    which some programs ignore. `base_color` (linear light) is used for meshes without colours.

    **Raises:** `ValueError` if clips do not fit the rig, or the name does not end in `.glb`;
    `OSError` if the file cannot be written; an existing file stays unchanged.
    """
    check_glb_path(path)
    data = glb_bytes(rig, clips, influences=influences, base_color=base_color)
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def check_glb_path(path: str | os.PathLike[str]) -> None:
    """**Raises:** `ValueError` unless the name ends in `.glb`."""
    if not os.fspath(path).lower().endswith(".glb"):
        raise ValueError(f"{os.fspath(path)}: binary glTF files end in .glb")


def glb_bytes(
    rig: Rig,
    clips: Sequence[Clip] = (),
    *,
    influences: Literal[4, 8] | int = 4,
    base_color: Color = SKIN_COLOR_LINEAR,
) -> bytes:
    """Contents of the file that `write_glb` writes."""
    import pygltflib

    _check(rig, clips, influences)
    joints = rig.tree.num_joints
    store = _Store()
    inverse = np.linalg.inv(rig.bind)
    inverse[:, 3] = (0, 0, 0, 1)  # the format requires it exactly
    columns = inverse.transpose(0, 2, 1).astype("<f4")  # glTF stores columns
    skin = pygltflib.Skin(
        name="skeleton",
        joints=list(range(joints)),
        skeleton=0,
        inverseBindMatrices=store.add(columns),
    )
    color = base_color if rig.mesh.colors is None else (1.0, 1.0, 1.0)
    material = pygltflib.Material(
        name="avatar",
        pbrMetallicRoughness=pygltflib.PbrMetallicRoughness(
            baseColorFactor=[*map(float, color), 1.0], metallicFactor=0.0, roughnessFactor=0.8
        ),
    )
    gltf = pygltflib.GLTF2(
        asset=pygltflib.Asset(version="2.0", generator=f"xavatar_jax {__version__}"),
        scene=0,
        scenes=[pygltflib.Scene(nodes=[0, joints])],
        nodes=[*_joint_nodes(rig), pygltflib.Node(name="avatar", mesh=0, skin=0)],
        skins=[skin],
        meshes=[_mesh(rig, store, influences)],
        materials=[material],
        animations=[_animation(rig, clip, store) for clip in clips],
        accessors=store.accessors,
        bufferViews=store.views,
    )
    gltf.buffers = [pygltflib.Buffer(byteLength=len(store.data))]
    gltf.set_binary_blob(bytes(store.data))
    parts: Any = gltf.save_to_bytes()
    return b"".join(parts)


class _Store:
    """Arrays in one buffer, each with its view and accessor."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[Any] = []
        self.accessors: list[Any] = []

    def add(
        self,
        array: np.ndarray,
        *,
        target: int | None = None,
        bounds: bool = False,
        normalized: bool = False,
    ) -> int:
        """Append an array of elements (rows) and return the number of its accessor."""
        import pygltflib

        array = np.ascontiguousarray(array)
        kinds = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
        flat = array.reshape(len(array), -1)
        self.data += b"\0" * (-len(self.data) % 4)
        self.views.append(
            pygltflib.BufferView(
                buffer=0, byteOffset=len(self.data), byteLength=array.nbytes, target=target
            )
        )
        self.accessors.append(
            pygltflib.Accessor(
                bufferView=len(self.views) - 1,
                componentType=_TYPES[array.dtype.str],
                normalized=normalized,
                count=len(array),
                type=kinds[array.shape[1:]],
                min=flat.min(0).tolist() if bounds else None,
                max=flat.max(0).tolist() if bounds else None,
            )
        )
        self.data += array.tobytes()
        return len(self.accessors) - 1

    def add_vertices(self, array: np.ndarray, **options: Any) -> int:
        return self.add(array, target=_VERTEX_DATA, **options)


def _check(rig: Rig, clips: Sequence[Clip], influences: int) -> None:
    if influences not in (4, 8):
        raise ValueError(f"{influences} influences per vertex; glTF has sets of four: use 4 or 8")
    names = [clip.name for clip in clips]
    if len(set(names)) < len(names):
        raise ValueError(f"clips have the same name: {', '.join(names)}")
    for clip in clips:
        found = (clip.rotations.shape[1], clip.coefficients.shape[1:])
        expected = (rig.tree.num_joints, (len(rig.target_names),))
        if found != expected:
            raise ValueError(
                f"clip {clip.name!r} has (joints, coefficients) {found}, the rig {expected}"
            )


def _joint_nodes(rig: Rig) -> list[Any]:
    import pygltflib

    rotations = rotation_quaternions(rig.rotations[None])[0]
    return [
        pygltflib.Node(
            name=name,
            rotation=rotation.tolist(),
            translation=translation.tolist(),
            children=list(rig.tree.children(joint)),
        )
        for joint, (name, rotation, translation) in enumerate(
            zip(rig.tree.names, rotations, rig.translations.astype(np.float32), strict=True)
        )
    ]


def _mesh(rig: Rig, store: _Store, influences: int) -> Any:
    import pygltflib

    mesh = rig.mesh
    attributes: dict[str, int] = {
        "POSITION": store.add_vertices(mesh.vertices.astype("<f4"), bounds=True)
    }
    if mesh.normals is not None:
        normals = mesh.normals.astype(np.float64)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        # Vertices of degenerate triangles have no normal; any unit vector is valid.
        normals = np.where(length > 0, normals / np.maximum(length, 1e-30), (0.0, 0.0, 1.0))
        attributes["NORMAL"] = store.add_vertices(normals.astype("<f4"))
    if mesh.colors is not None:
        linear = linear_colors(mesh.colors)
        attributes["COLOR_0"] = store.add_vertices(linear.astype("<u2"), normalized=True)
    limited = limit_influences(rig.weights, influences)
    small = "|u1" if rig.tree.num_joints <= 256 else "<u2"
    for group in range(influences // 4):
        columns = slice(4 * group, 4 * group + 4)
        attributes[f"JOINTS_{group}"] = store.add_vertices(limited.joints[:, columns].astype(small))
        attributes[f"WEIGHTS_{group}"] = store.add_vertices(
            limited.weights[:, columns].astype("<f4")
        )
    index = "<u2" if mesh.num_vertices < 2**16 else "<u4"
    faces = store.add(mesh.faces.reshape(-1).astype(index), target=_INDEX_DATA)
    targets: list[Any] = [
        {"POSITION": store.add_vertices(shape.astype("<f4"), bounds=True)} for shape in rig.targets
    ]
    primitive = pygltflib.Primitive(
        attributes=pygltflib.Attributes(**attributes), indices=faces, material=0, targets=targets
    )
    return pygltflib.Mesh(
        name="avatar",
        primitives=[primitive],
        weights=[0.0] * len(targets),
        extras={"targetNames": list(rig.target_names)} if targets else {},
    )


def linear_colors(colors: UInt8[np.ndarray, "V C"]) -> UInt16[np.ndarray, "V 4"]:
    """Convert 8-bit sRGB colours to 16-bit linear RGBA, as glTF defines vertex colours."""
    values = colors.astype(np.float64) / 255
    rgb = values[:, :3]
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    alpha = values[:, 3:] if colors.shape[1] == 4 else np.ones((len(colors), 1))
    return np.round(65535 * np.concatenate([linear, alpha], axis=1)).astype(np.uint16)


def _animation(rig: Rig, clip: Clip, store: _Store) -> Any:
    """Rotations of all joints, translations of moving joints, blend shape coefficients."""
    import pygltflib

    animation = pygltflib.Animation(name=clip.name)
    times = store.add((np.arange(len(clip)) / clip.fps).astype("<f4"), bounds=True)

    def channel(node: int, path: str, values: np.ndarray) -> None:
        sampler = pygltflib.AnimationSampler(input=times, output=store.add(values.astype("<f4")))
        animation.samplers.append(sampler)
        target = pygltflib.AnimationChannelTarget(node=node, path=path)
        number = len(animation.samplers) - 1
        animation.channels.append(pygltflib.AnimationChannel(sampler=number, target=target))

    rotations = rotation_quaternions(clip.rotations)
    shifts = np.abs(clip.translations - rig.translations).max((0, 2))
    for joint in range(rig.tree.num_joints):
        channel(joint, "rotation", rotations[:, joint])
        if joint == 0 or shifts[joint] > 1e-7:
            channel(joint, "translation", clip.translations[:, joint])
    if rig.target_names:
        channel(rig.tree.num_joints, "weights", clip.coefficients.reshape(-1))
    return animation
