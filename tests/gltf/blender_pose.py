"""Run by an interpreter that has `bpy`: import a GLB, pose it frame by frame, save vertices.

    python blender_pose.py FILE.glb OUT.npz FPS FRAME [FRAME ...]

Vertices come back as Blender evaluates them, in glTF's axes (y up).
"""

import sys

import bpy
import numpy as np


def main() -> None:
    path, out, fps, *frames = sys.argv[1:]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = round(float(fps))
    bpy.ops.import_scene.gltf(filepath=path)
    mesh = next(o for o in scene.objects if o.type == "MESH" and o.find_armature())
    armature = mesh.find_armature()
    posed = []
    for frame in map(int, frames):
        scene.frame_set(frame)
        evaluated = mesh.evaluated_get(bpy.context.evaluated_depsgraph_get())
        data = evaluated.to_mesh()
        points = np.empty(3 * len(data.vertices), np.float32)
        data.vertices.foreach_get("co", points)
        world = np.asarray(evaluated.matrix_world)
        points = points.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3]
        evaluated.to_mesh_clear()
        posed.append(np.stack([points[:, 0], points[:, 2], -points[:, 1]], axis=1))
    keys = mesh.data.shape_keys
    start, end = armature.animation_data.action.frame_range
    np.savez(
        out,
        vertices=np.stack(posed),
        bones=np.asarray([bone.name for bone in armature.data.bones]),
        shapes=np.asarray([key.name for key in keys.key_blocks] if keys else []),
        frame_range=np.asarray([start, end]),
        version=np.asarray(bpy.app.version_string),
    )


main()
