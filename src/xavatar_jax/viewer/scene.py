"""The 3D scene in the browser: ground, lights, camera, and one surface that changes."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from jaxtyping import Float

from ..render import Camera, to_linear
from .surfaces import Surface

# The browser reloads meshes with vertex colours; the old one stays this many seconds.
_OVERLAP = 0.2
_UNCOLORED, _COLORED = "/surface", "/colored_{}"


class Scene:
    """The scene that the browser shows.

    Args:
        server: a viser server.
        camera: initial camera.
        target: the point it looks at.
        up: the world's up axis, "y" or "z".
    """

    def __init__(
        self,
        server: Any,
        camera: Camera,
        target: Float[np.ndarray, "3"],
        up: str,
    ) -> None:
        self._scene = server.scene
        self._uncolored: Any = None
        self._faces: Any = None
        self._colored: Any = None
        self._turn = 0
        self._scene.set_up_direction(f"+{up}")
        self._scene.configure_default_lights(enabled=False)
        _add_lights(self._scene, camera, target)
        start = server.initial_camera
        start.position, start.look_at = tuple(camera.position), tuple(target)
        start.up, start.fov = tuple(camera.up), camera.fov
        self._up = np.asarray(camera.up)
        self._below = np.asarray(target) - (np.asarray(target) @ self._up) * self._up
        self._ground = self._scene.add_grid(
            "/ground",
            plane="xz" if up == "y" else "xy",
            visible=False,
            width=12.0,
            height=12.0,
            cell_size=0.5,
            section_size=0.5,
            cell_color=(226, 227, 230),
            section_color=(222, 223, 227),
            fade_distance=9.0,
            fade_strength=2.0,
            shadow_opacity=0.18,
        )

    def place_ground(self, height: float) -> None:
        """Show the ground at a height along the up axis, metres."""
        self._ground.position = tuple(self._below + height * self._up)
        self._ground.visible = True

    def show(self, surface: Surface) -> None:
        """Replace the surface shown."""
        if surface.colors is None:
            self._show_uncolored(surface)
        else:
            self._show_colored(surface)

    def _show_uncolored(self, surface: Surface) -> None:
        red, green, blue = (round(255 * c) for c in surface.color)
        color = (red, green, blue)
        if self._uncolored is None or self._faces is not surface.faces:
            self._uncolored = self._scene.add_mesh_simple(
                _UNCOLORED, surface.vertices, surface.faces, color=color, side="double"
            )
            self._faces = surface.faces
        else:
            self._uncolored.vertices = surface.vertices
            if tuple(self._uncolored.color) != color:
                self._uncolored.color = color
        self._uncolored.visible = True
        if self._colored is not None:
            self._colored.remove()
            self._colored = None

    def _show_colored(self, surface: Surface) -> None:
        before, self._turn = self._colored, 1 - self._turn
        name = _COLORED.format(self._turn)
        self._colored = self._scene.add_glb(name, _glb(surface))
        time.sleep(_OVERLAP)
        if before is not None:
            before.remove()
        if self._uncolored is not None:
            self._uncolored.visible = False


def _add_lights(scene: Any, camera: Camera, target: Float[np.ndarray, "3"]) -> None:
    """A key light from the upper left that casts the shadow, fill and rim lights, and the sky."""
    right, _, forward = camera.rotation
    up = np.asarray(camera.up)
    level = -forward + (forward @ up) * up
    level = level / max(float(np.linalg.norm(level)), 1e-6)
    for name, direction, color, strength, shadow in (
        ("/key", -0.7 * right + 1.3 * up + 0.8 * level, (255, 247, 236), 2.3, True),
        ("/fill", 0.9 * right + 0.3 * up + 0.5 * level, (220, 230, 255), 0.4, False),
        ("/rim", 0.4 * right + 0.6 * up - 0.9 * level, (255, 255, 255), 0.5, False),
    ):
        scene.add_light_directional(
            name,
            color=color,
            intensity=strength,
            cast_shadow=shadow,
            position=tuple(np.asarray(target) + 4.0 * direction),
            visible=True,
        )
    scene.add_light_hemisphere(
        "/sky", sky_color=(245, 247, 255), ground_color=(205, 198, 190), intensity=0.75
    )


def _glb(surface: Surface) -> bytes:
    """The coloured surface as binary glTF without a rig; glTF colours are linear."""
    import trimesh
    from trimesh.visual import ColorVisuals
    from trimesh.visual.material import PBRMaterial

    assert surface.colors is not None
    linear = np.round(255 * to_linear(surface.colors[:, :3] / 255.0)).astype(np.uint8)
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    mesh.visual = ColorVisuals(mesh, vertex_colors=linear)
    mesh.visual.material = PBRMaterial(  # pyright: ignore
        metallicFactor=0.0, roughnessFactor=0.9, doubleSided=True
    )
    data = mesh.export(file_type="glb")
    assert isinstance(data, bytes)
    return data
