"""`view`: show an avatar in the browser, posed by sliders or playing a motion."""

from __future__ import annotations

import contextlib
import io
import sys
import threading
import time
from typing import Any

import jax
import numpy as np

from ..avatar import DEFAULT_FPS, Drivable, MotionLike, animate
from ..body import BodyParams, canonical_params, facing, root_rotation
from ..frames import Frames
from ..render import frame_view
from .panel import Panel
from .scene import Scene
from .surfaces import UP, Request, Surfaces, UpAxis, frame_of, rest_params

# Frames per second that the player sends at most.
_FASTEST = 30.0


class Viewer:
    """A running viewer, made by `view`. Notebooks display it inline.

    - `url`: address of the page.
    - `panel`: handles of its sliders, for scripts: `viewer.panel.frame.value = 10`.
    - `shown`: the request for which the current surface was made.
    """

    def __init__(
        self,
        server: Any,
        scene: Scene,
        panel: Panel,
        surfaces: Surfaces,
        fps: float,
        changed: threading.Event,
    ):
        self._server, self._scene, self._surfaces, self._fps = server, scene, surfaces, fps
        self.panel = panel
        self.shown: Request | None = None
        self.url = f"http://{_reachable(server.get_host())}:{server.get_port()}"
        self._changed = changed
        self._shown = threading.Event()
        self._stopped = threading.Event()
        self._error: BaseException | None = None
        self._worker = threading.Thread(target=self._work, name="viewer", daemon=True)
        self._worker.start()

    def wait_until_shown(self, timeout: float | int | None = None) -> None:
        """Wait until the avatar's surface, which is extracted on first use, is shown.

        **Raises:** `TimeoutError`, and any error of the extraction.
        """
        if not self._shown.wait(timeout):
            raise TimeoutError(f"no surface after {timeout} s")
        if self._error is not None:
            raise self._error

    def wait(self) -> None:
        """Run until Ctrl-C, then stop. **Raises:** the error that ended the viewer, if any."""
        try:
            while not self._stopped.wait(0.5):
                pass
        except KeyboardInterrupt as stop:
            if type(stop) is not KeyboardInterrupt:  # a signal converted to an exception
                raise
        finally:
            self.stop()
        if self._error is not None:
            raise self._error

    def stop(self) -> None:
        """Close the page's server."""
        if self._server is None:
            return
        self._stopped.set()
        self._changed.set()
        if self._worker.is_alive() and self._worker is not threading.current_thread():
            self._worker.join(timeout=10)
        self._server.stop()
        self._server = None

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.url}" style="width: 100%; height: 640px; border: 0"></iframe>'

    def __repr__(self) -> str:
        return f"Viewer({self.url})"

    def _work(self) -> None:
        try:
            self._run()
        except BaseException as error:
            self._error = error
            self.panel.say(f"**Stopped:** {error}")
            self._shown.set()
            self._stopped.set()
            print(f"the viewer stopped: {error}", file=sys.stderr)

    def _run(self) -> None:
        self.panel.say("Extracting the avatar's surface; showing the body until then.")
        self._scene.show(self._surfaces.template(0))
        self._scene.place_ground(self._surfaces.ground_height())
        self._surfaces.avatar.rest  # noqa: B018  # extracted on first use
        self.panel.say("")
        clock = _Clock(self.panel, self._fps)
        while not self._stopped.is_set():
            started = time.perf_counter()
            if self.panel.playing.value:
                clock.advance(started)
            else:
                clock.pause()
            self._changed.clear()
            request = self.panel.request()
            if request != self.shown:
                self._show(request)
            if self.panel.playing.value:
                pause = 1.0 / _FASTEST - (time.perf_counter() - started)
                self._stopped.wait(max(pause, 0.001))
            else:
                self._changed.wait()

    def _show(self, request: Request) -> None:
        try:
            surface = self._surfaces(request)
        except Exception as error:  # a frame that cannot be read must not end the viewer
            self.panel.say(f"**Frame {request.frame} cannot be shown:** {error}")
            print(f"frame {request.frame} cannot be shown: {error}", file=sys.stderr)
        else:
            self._scene.show(surface)
            self.panel.say(surface.note)
        self.shown = request
        self._shown.set()


class _Clock:
    """Moves the frame slider by the time that has passed."""

    def __init__(self, panel: Panel, fps: float):
        self._panel, self._fps = panel, fps
        self._place: float | None = None
        self._at, self._seeks = 0.0, 0

    def pause(self) -> None:
        self._place = None

    def advance(self, now: float) -> None:
        slider = self._panel.frame
        if self._place is None or self._seeks != self._panel.seeks:
            self._place, self._seeks = float(slider.value), self._panel.seeks
        else:
            self._place += (now - self._at) * self._fps * float(self._panel.speed.value)
            self._place %= float(slider.max) + 1.0
        self._at = now
        if int(self._place) != int(slider.value):
            slider.value = int(self._place)


def view(
    avatar: Drivable,
    motion: MotionLike | BodyParams | None = None,
    frames: Frames | None = None,
    *,
    port: int = 8080,
    host: str = "localhost",
    open: bool = False,
    up: UpAxis | None = None,
    max_error_mm: float = 2.0,
    verbose: bool = True,
) -> Viewer:
    """Show an avatar in the browser: pose it with sliders, play a motion, inspect its weights.

    Returns at once; the page shows the body until the avatar's surface is extracted. In a script,
    `view(...).wait()` keeps it open until Ctrl-C; notebooks display the result inline. If it runs
    on another machine, `ssh -L 8080:localhost:8080 HOST` and open the address locally.

    Args:
        avatar: the avatar to show.
        motion: a motion, or parameters `(T, ...)` at 30 frames per second. Default: the motion of
            `frames`, else the rest pose.
        frames: ground truth, one mesh for each frame of the motion.
        port: of the page; if it is taken, the next free one is used.
        host: "localhost" serves this machine only, "0.0.0.0" the whole network.
        open: open the page in the local browser.
        up: the world axis that points up. Default: that of the motion; y for parameters.
        max_error_mm: the distance shown in red.
        verbose: print the address.

    Raises:
        ImportError: if viser is missing.
        ValueError: if the parameters do not fit the body, the numbers of frames differ, or as for
            `Avatar.animate`.
        TypeError: if `motion` is not a motion.
    """
    viser = _viser()
    driven = motion if motion is not None else None if frames is None else frames.params
    animation = animate(avatar, rest_params(avatar) if driven is None else driven)
    if frames is not None and len(frames) != len(animation):
        raise ValueError(
            f"{len(frames)} frames of ground truth for a motion of {len(animation)} frames: give "
            "one mesh for each frame, or leave out the motion."
        )
    axis: UpAxis = up or getattr(motion, "up", "y")
    if axis not in UP:
        raise ValueError(f"up axis {axis!r}; it must be 'y' or 'z'")
    params = jax.tree.map(np.asarray, animation.params)
    surfaces = Surfaces(avatar, params, frames, np.asarray(UP[axis]), max_error_mm)
    with contextlib.redirect_stdout(io.StringIO()):  # hides its table of addresses
        server = viser.ViserServer(host=host, port=port, label="xavatar_jax", verbose=False)
    try:
        viewer = _start(
            server, surfaces, axis, animation.fps if driven is not None else DEFAULT_FPS
        )
    except BaseException:
        server.stop()
        raise
    if verbose:
        print(f"viewer: {viewer.url}")
    if open:
        import webbrowser

        webbrowser.open(viewer.url)
    return viewer


def _start(server: Any, surfaces: Surfaces, axis: UpAxis, fps: float) -> Viewer:
    """Create scene and panel, and start the thread that connects them."""
    body, first = surfaces.avatar.body, frame_of(surfaces.params, 0)
    # The rest pose with the frame's root: available at once, and close enough for the first view.
    outline = np.asarray(body.template) @ root_rotation(first).T + np.asarray(first.transl)
    camera = frame_view(
        outline[:: max(len(outline) // 2000, 1)],
        "three_quarter",
        up=UP[axis],
        forward=tuple(facing(first, axis)),
        margin=1.05,
    )
    middle = 0.5 * (outline.min(axis=0) + outline.max(axis=0))
    scene = Scene(server, camera, middle, axis)
    changed = threading.Event()
    panel = Panel(
        server,
        body.tree,
        num_frames=len(surfaces.params),
        num_expression=canonical_params(body).expression.shape[-1],
        shadings=surfaces.shadings,
        max_error_mm=surfaces.max_error_mm,
        changed=changed.set,
    )
    return Viewer(server, scene, panel, surfaces, fps, changed)


def _reachable(host: str) -> str:
    return "localhost" if host in ("0.0.0.0", "::") else host


def _viser() -> Any:
    try:
        import viser
    except ImportError as error:
        raise ImportError(
            'the viewer needs viser: in a clone of the project, pip install -e ".[view]". '
            "`xa.view_html` needs no extra package and writes a page that plays offline."
        ) from error
    return viser
