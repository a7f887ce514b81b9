"""Files of other programs, written as those write them and without the library's own writers."""

from __future__ import annotations

import contextlib
import json
import pickle
import sys
import types
import zlib
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation


def matrices(vectors: np.ndarray) -> np.ndarray:
    """Axis-angle `(..., 3)` as matrices `(..., 3, 3)`."""
    flat = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    return flat.reshape(*vectors.shape, 3)


@contextlib.contextmanager
def joblib_names():
    """joblib's class for arrays, under its name, for as long as something is pickled."""
    wrapper = type("NumpyArrayWrapper", (), {"__module__": "joblib.numpy_pickle"})
    modules = {name: types.ModuleType(name) for name in ("joblib", "joblib.numpy_pickle")}
    modules["joblib.numpy_pickle"].NumpyArrayWrapper = wrapper
    before = {name: sys.modules.get(name) for name in modules}
    sys.modules.update(modules)
    try:
        yield wrapper
    finally:
        for name, module in before.items():
            sys.modules.pop(name)
            if module is not None:
                sys.modules[name] = module


def joblib_dump(path: Path, value, *, protocol: int = 4, compress: bool = False) -> Path:
    """A pickle with a record in the place of each array and the array's bytes behind it."""
    with joblib_names() as wrapper, open(path, "wb") as file:
        # The pickler in Python: its `save` can be replaced. Stubs leave it out.
        class Pickler(pickle._Pickler):  # type: ignore[name-defined]
            def save(self, obj, save_persistent_id=True):
                if type(obj) is not np.ndarray:
                    super().save(obj, save_persistent_id)
                    return
                record = wrapper()
                record.__dict__ = {
                    "subclass": np.ndarray, "shape": obj.shape, "order": "C", "dtype": obj.dtype,
                    "allow_mmap": True, "numpy_array_alignment_bytes": 16,
                }  # fmt: skip
                self.keep.append(record)
                super().save(record, save_persistent_id)
                self.framer.commit_frame(force=True)
                padding = 16 - (file.tell() + 1) % 16
                file.write(bytes([padding]) + b"\xff" * padding + obj.tobytes())

        pickler = Pickler(file, protocol)
        pickler.keep = []
        pickler.dump(value)
    if compress:
        path.write_bytes(zlib.compress(path.read_bytes(), 3))
    return path


def smplx_numbers(count: int, seed: int = 0, size: float = 0.3) -> dict[str, np.ndarray]:
    """Parameters of `count` frames by SMPL-X's names, axis-angle, hands of whatever kind."""
    rng = np.random.default_rng(seed)
    widths = {
        "global_orient": 3, "body_pose": 63, "left_hand_pose": 45, "right_hand_pose": 45,
        "jaw_pose": 3, "leye_pose": 3, "reye_pose": 3,
    }  # fmt: skip
    numbers = {name: size * rng.normal(size=(count, width)) for name, width in widths.items()}
    numbers |= {"transl": rng.normal(size=(count, 3)), "expression": rng.normal(size=(count, 10))}
    return numbers | {"betas": np.tile(rng.normal(size=10), (count, 1))}


def xhumans(subject: Path, numbers: dict[str, np.ndarray], first: int = 1) -> Path:
    """`SUBJECT/test/Take3/SMPLX/mesh-fNNNNN_smplx.pkl`, flat vectors."""
    folder = subject / "test" / "Take3" / "SMPLX"
    folder.mkdir(parents=True)
    for k in range(len(numbers["body_pose"])):
        frame = {name: values[k].astype(np.float32) for name, values in numbers.items()}
        file = folder / f"mesh-f{k + first:05d}_smplx.pkl"
        file.write_bytes(pickle.dumps(frame, 4))
    return folder


def smplerx(folder: Path, numbers: dict[str, np.ndarray], frames, person: int = 0) -> Path:
    """`FOLDER/smplx/NNNNN_P.npz`, joints in rows."""
    (folder / "smplx").mkdir(parents=True, exist_ok=True)
    for k, frame in enumerate(frames):
        rows = {
            n: v[k].reshape(-1, 3) for n, v in numbers.items() if n.endswith(("pose", "orient"))
        }
        rows["transl"] = numbers["transl"][[k]]
        rows |= {name: numbers[name][[k]] for name in ("betas", "expression")}
        np.savez(folder / "smplx" / f"{frame:05d}_{person}.npz", **rows)
    return folder


def pymafx(numbers: dict[str, np.ndarray], batch: int) -> dict:
    """The result of PyMAF-X: batches of matrices, 24 body joints with the root first."""
    count = len(numbers["body_pose"])
    body = np.concatenate(
        [numbers["global_orient"], numbers["body_pose"], np.zeros((count, 6))], axis=1
    ).reshape(count, 24, 3)
    values = {
        "shape": numbers["betas"],
        "body_pose": matrices(body),
        "left_hand_pose": matrices(numbers["left_hand_pose"].reshape(count, 15, 3)),
        "right_hand_pose": matrices(numbers["right_hand_pose"].reshape(count, 15, 3)),
        "jaw_pose": matrices(numbers["jaw_pose"][:, None]),
        "leye_pose": matrices(numbers["leye_pose"][:, None]),
        "reye_pose": matrices(numbers["reye_pose"][:, None]),
        "expression": np.pad(numbers["expression"], ((0, 0), (0, 40))),
    }
    starts = range(0, count, batch)
    return {
        "smplx_params": [{n: v[s : s + batch] for n, v in values.items()} for s in starts],
        "orig_cam_t": numbers["transl"],
        "frame_ids": np.arange(count),
        "person_ids": [f"img_f{k}_p0" for k in range(count)],
    }


def phalp(tracks: dict[int, dict[int, tuple[np.ndarray, np.ndarray]]], betas: np.ndarray) -> dict:
    """The result of PHALP. `tracks[person][frame]` are poses (24, 3) and a camera translation."""
    frames = sorted({frame for track in tracks.values() for frame in track})
    result = {}
    for frame in range(frames[0], frames[-1] + 1):
        entry = {"time": frame, "shot": 0, "tid": [], "smpl": [], "camera": [], "tracked_time": []}
        for person, track in tracks.items():
            seen = frame in track
            # A person who is lost stays in the list for some frames, with the last pose.
            known = frame if seen else max((f for f in track if f < frame), default=None)
            if known is None:
                continue
            pose, camera = track[known]
            whole = matrices(pose)
            entry["tid"].append(person)
            entry["smpl"].append(
                {"global_orient": whole[:1], "body_pose": whole[1:], "betas": betas}
            )
            entry["camera"].append(camera)
            entry["tracked_time"].append(0 if seen else frame - known)
        result[f"images/{frame:06d}.jpg"] = entry
    return result


def easymocap(folder: Path, people: dict[int, dict[str, np.ndarray]]) -> Path:
    """`FOLDER/smpl/NNNNNN.json`, every value a list of rows."""
    (folder / "smpl").mkdir(parents=True)
    count = len(next(iter(people.values()))["Rh"])
    for k in range(count):
        listed = [
            {"id": person, **{name: values[k][None].tolist() for name, values in numbers.items()}}
            for person, numbers in people.items()
        ]
        (folder / "smpl" / f"{k:06d}.json").write_text(json.dumps(listed))
    return folder


def bvh(joints, rows, interval: float = 1 / 30) -> str:
    """A BVH file from `(depth, name, offset, channels)` in order, `channels` None for an end."""
    lines = ["HIERARCHY"]
    depths = [depth for depth, *_ in joints] + [0]
    for k, (depth, name, offset, channels) in enumerate(joints):
        pad = "  " * depth
        kind = "End Site" if channels is None else ("JOINT" if depth else "ROOT") + f" {name}"
        lines += [f"{pad}{kind}", f"{pad}{{", f"{pad}  OFFSET {' '.join(map(repr, offset))}"]
        if channels is not None:
            lines.append(f"{pad}  CHANNELS {len(channels)} {' '.join(channels)}")
        lines += ["  " * d + "}" for d in range(depth, depths[k + 1] - 1, -1)]
    lines += ["MOTION", f"Frames: {len(rows)}", f"Frame Time: {interval:.6f}"]
    return "\n".join([*lines, *(" ".join(f"{v:.9f}" for v in row) for row in rows)])
