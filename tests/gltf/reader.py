"""A reader of GLB files written for the tests: raw JSON and buffers, skinning in NumPy.

Written from the glTF 2.0 specification. It shares no code with the writer.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

_COMPONENTS = {5121: "<u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class GltfFile:
    """JSON, accessors and posing of a file with one skinned mesh."""

    def __init__(self, path: str | Path):
        data = Path(path).read_bytes()
        magic, version, length = struct.unpack("<4sII", data[:12])
        assert (magic, version, length) == (b"glTF", 2, len(data))
        chunks, at = [], 12
        while at < len(data):
            size, kind = struct.unpack("<I4s", data[at : at + 8])
            assert size % 4 == 0
            chunks.append((kind, data[at + 8 : at + 8 + size]))
            at += 8 + size
        assert [kind for kind, _ in chunks] == [b"JSON", b"BIN\0"]
        self.json: dict[str, Any] = json.loads(chunks[0][1])
        self.buffer = chunks[1][1]
        node = next(n for n in self.json["nodes"] if "mesh" in n)
        self.mesh_node = self.json["nodes"].index(node)
        self.mesh = self.json["meshes"][node["mesh"]]
        self.skin = self.json["skins"][node["skin"]]
        (self.primitive,) = self.mesh["primitives"]

    def accessor(self, number: int) -> np.ndarray:
        """Rows of an accessor; normalised integers come back as they are stored."""
        entry = self.json["accessors"][number]
        view = self.json["bufferViews"][entry["bufferView"]]
        width = _WIDTH[entry["type"]]
        start = view.get("byteOffset", 0) + entry.get("byteOffset", 0)
        assert start % 4 == 0
        values = np.frombuffer(
            self.buffer,
            _COMPONENTS[entry["componentType"]],
            count=entry["count"] * width,
            offset=start,
        )
        assert values.nbytes <= view["byteLength"]
        rows = values.reshape(entry["count"], width)
        if "min" in entry:
            assert rows.min(0).tolist() == entry["min"]
            assert rows.max(0).tolist() == entry["max"]
        return rows

    def attribute(self, name: str) -> np.ndarray:
        return self.accessor(self.primitive["attributes"][name])

    @property
    def faces(self) -> np.ndarray:
        return self.accessor(self.primitive["indices"]).reshape(-1, 3).astype(int)

    def weights(self) -> np.ndarray:
        """Dense skinning weights (V, J), from all sets of influences."""
        attributes = self.primitive["attributes"]
        count = len(self.attribute("POSITION"))
        dense = np.zeros((count, len(self.skin["joints"])))
        for k in range(sum(name.startswith("JOINTS_") for name in attributes)):
            joints, weights = self.attribute(f"JOINTS_{k}"), self.attribute(f"WEIGHTS_{k}")
            for column in range(4):
                dense[np.arange(count), joints[:, column]] += weights[:, column]
        return dense

    def targets(self) -> np.ndarray:
        """Displacements of the blend shapes (E, V, 3)."""
        found = [self.accessor(t["POSITION"]) for t in self.primitive.get("targets", [])]
        return np.stack(found) if found else np.zeros((0, len(self.attribute("POSITION")), 3))

    def posed(self, time: float | None = None, clip: int = 0) -> np.ndarray:
        """Vertices (V, 3) at a time of a clip (linear between keys), or as the nodes stand."""
        state = [dict(node) for node in self.json["nodes"]]
        if time is not None:
            for channel in self.json["animations"][clip]["channels"]:
                sampler = self.json["animations"][clip]["samplers"][channel["sampler"]]
                keys = self.accessor(sampler["input"])[:, 0].astype(float)
                rows = self.accessor(sampler["output"]).astype(float).reshape(len(keys), -1)
                target = channel["target"]
                state[target["node"]][target["path"]] = _at(keys, rows, time, target["path"])
        world: dict[int, np.ndarray] = {}
        parents = {c: n for n, node in enumerate(state) for c in node.get("children", [])}

        def transform(node: int) -> np.ndarray:
            if node not in world:
                local = _matrix(state[node])
                world[node] = transform(parents[node]) @ local if node in parents else local
            return world[node]

        inverse = self.accessor(self.skin["inverseBindMatrices"]).astype(float)
        matrices = np.stack(
            [
                transform(joint) @ inverse[k].reshape(4, 4).T
                for k, joint in enumerate(self.skin["joints"])
            ]
        )
        points = self.attribute("POSITION").astype(float)
        shape = state[self.mesh_node].get("weights", self.mesh.get("weights", []))
        for weight, target in zip(shape, self.targets(), strict=True):
            points = points + weight * target
        blended = np.einsum("vj,jab->vab", self.weights(), matrices)
        return np.einsum("vab,vb->va", blended[:, :3, :3], points) + blended[:, :3, 3]


def _at(keys: np.ndarray, rows: np.ndarray, time: float, path: str) -> np.ndarray:
    k = int(np.clip(np.searchsorted(keys, time, side="right") - 1, 0, max(len(keys) - 2, 0)))
    if len(keys) == 1:
        return rows[0]
    share = float(np.clip((time - keys[k]) / (keys[k + 1] - keys[k]), 0, 1))
    first, second = rows[k], rows[k + 1]
    if path != "rotation":
        return (1 - share) * first + share * second
    cosine = float(np.clip(first @ second, -1, 1))
    angle = np.arccos(cosine)
    if angle < 1e-6:
        return (1 - share) * first + share * second
    return (np.sin((1 - share) * angle) * first + np.sin(share * angle) * second) / np.sin(angle)


def _matrix(node: dict[str, Any]) -> np.ndarray:
    x, y, z, w = np.asarray(node.get("rotation", (0, 0, 0, 1)), float)
    assert abs(x * x + y * y + z * z + w * w - 1) < 1e-5
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix
