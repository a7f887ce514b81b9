"""The shadow of a mesh on the ground."""

import numpy as np
from jaxtyping import Float

from .camera import Camera
from .light import key_visibility, openness
from .subject import Subject

_NODES, _RAYS = 72, 24
# How much darker the ground gets without any sky, and without the key light.
_SKY_SHARE, _KEY_SHARE = 0.85, 0.30


def ground_shadow(
    subject: Subject, camera: Camera, size: tuple[int, int], height: float
) -> Float[np.ndarray, "H W"]:
    """How dark the mesh makes the ground in each pixel, 0 to 1; `size` is width and height.

    Args:
        subject: what stands on the ground.
        camera: from where it is seen.
        size: of the picture, pixels.
        height: of the ground along the camera's up, metres.
    """
    from scipy.ndimage import gaussian_filter, map_coordinates

    up = camera.up
    across = np.linalg.svd(up[None])[2][1:]
    flat = subject.mesh.vertices @ across.T
    low, high = flat.min(axis=0), flat.max(axis=0)
    room = 0.35 * float((high - low).max())
    low, high = low - room, high + room
    steps = [np.linspace(low[i], high[i], _NODES) for i in range(2)]
    nodes = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 2)
    points = nodes @ across + height * up
    normals = np.broadcast_to(up, (len(nodes), 3))
    reach, lift = 0.4 * subject.extent, 1e-3 * subject.extent
    sky = openness(subject.scene, points, normals, count=_RAYS, reach=reach, lift=lift)
    key = key_visibility(subject.scene, points, normals, camera, reach=reach, lift=lift)
    shape = (_NODES, _NODES)
    sky, key = (
        gaussian_filter(value.reshape(shape), sigma) for value, sigma in ((sky, 1.0), (key, 1.6))
    )
    grid = 1.0 - (1.0 - _SKY_SHARE * (1.0 - sky)) * (1.0 - _KEY_SHARE * (1.0 - key))
    # Fade out towards the patch's border, so that no border shows.
    fade = np.clip(4.0 * np.linspace(0, 1, _NODES), 0.0, 1.0)
    fade = np.minimum(fade, fade[::-1])
    grid *= fade[:, None] * fade
    below = float(camera.position @ up) - height
    rays = camera.rays(*size)
    slope = rays @ -up.astype(np.float32)
    # From below, the ground hides nothing.
    hit = (slope > 1e-6) & (below > 0)
    shadow = np.zeros(hit.shape, dtype=np.float32)
    toward = rays[hit]
    distance = below / slope[hit]
    place = (camera.position @ across.T) + distance[:, None] * (toward @ across.T)
    index = (place - low) / (high - low) * (_NODES - 1)
    shadow[hit] = map_coordinates(grid, index.T, order=1, mode="constant")
    return shadow
