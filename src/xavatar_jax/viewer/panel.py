"""The panel beside the scene: player, shading, sliders for joints and expression."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..kinematics import KinematicTree
from ..render import color_bar
from .surfaces import AVATAR, ERROR, WEIGHTS, Request, joint_choices

_ALL = "all bones"
_AXES = ("x", "y", "z")
_LARGEST_TURN, _LARGEST_EXPRESSION = 120.0, 3.0


class Panel:
    """The panel's handles and what they ask for.

    Args:
        server: a viser server.
        tree: joints of the body.
        num_frames: length of the motion.
        num_expression: number of expression coefficients.
        shadings: available shadings.
        max_error_mm: red end of the error colours.
        changed: called without arguments after every change.
    """

    def __init__(
        self,
        server: Any,
        tree: KinematicTree,
        *,
        num_frames: int,
        num_expression: int,
        shadings: tuple[str, ...],
        max_error_mm: float,
        changed: Callable[[], None],
    ) -> None:
        self._gui = server.gui
        self._tree = tree
        self._changed = changed
        self._turns: dict[int, list[float]] = {}
        self.seeks = 0
        self._gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        self._gui.set_panel_label("xavatar_jax")
        self._status = self._gui.add_markdown("")
        self._add_player(num_frames)
        self._add_shading(shadings, max_error_mm)
        self._groups = [
            self._add_joints(name, choices) for name, choices in joint_choices(tree).items()
        ]
        self._expression = self._add_expression(num_expression)
        self._reset = self._gui.add_button("Reset pose and expression")
        self._reset.on_click(lambda _: self.reset())

    def request(self) -> Request:
        """What the panel asks for now."""
        bone = None if self.bone.value == _ALL else self._tree.index(self.bone.value)
        turns = tuple(
            (joint, (t[0], t[1], t[2]))
            for joint, t in sorted(dict(self._turns).items())
            if any(abs(v) > 1e-9 for v in t)
        )
        return Request(
            frame=int(self.frame.value),
            shading=self.shading.value,
            bone=bone if self.shading.value == WEIGHTS else None,
            turns=turns,
            expression=tuple(float(slider.value) for slider in self._expression),
            in_place=bool(self.in_place.value),
        )

    def say(self, text: str) -> None:
        """Show a line at the top of the panel."""
        if self._status.content != text:
            self._status.content = text

    def reset(self) -> None:
        """Set all joint and expression sliders to zero."""
        self._turns.clear()
        for slider in self._expression:
            slider.value = 0.0
        for show in self._groups:
            show()
        self._changed()

    def set_turn(self, joint: int, degrees: tuple[float, float, float]) -> None:
        """Turn one joint as its sliders do."""
        self._turns[joint] = [float(np.deg2rad(v)) for v in degrees]
        for show in self._groups:
            show()
        self._changed()

    def _add_player(self, num_frames: int) -> None:
        moving = num_frames > 1
        with self._gui.add_folder("Motion", visible=moving):
            self.playing = self._gui.add_checkbox("Play", False, hint="Play the motion repeatedly")
            self.frame = self._gui.add_slider("Frame", 0, max(num_frames - 1, 1), 1, 0)
            self.speed = self._gui.add_slider("Speed", 0.1, 2.0, 0.1, 1.0)
            self.in_place = self._gui.add_checkbox("Stay in place", False)

        def sought(event: Any) -> None:
            # Moved by the user, not by the player.
            if event.client_id is not None:
                self.seeks += 1
            self._changed()

        self.frame.on_update(sought)
        for handle in (self.playing, self.speed, self.in_place):
            handle.on_update(lambda _: self._changed())

    def _add_shading(self, shadings: tuple[str, ...], max_error_mm: float) -> None:
        with self._gui.add_folder("Show"):
            self.shading = self._gui.add_dropdown("Surface", shadings, initial_value=AVATAR)
            self.bone = self._gui.add_dropdown("Bone", (_ALL, *self._tree.names), visible=False)
            bar = np.ascontiguousarray(color_bar(max_error_mm, (70, 180)))
            legend = self._gui.add_image(bar, visible=False)

        def chosen(_: Any) -> None:
            self.bone.visible = self.shading.value == WEIGHTS
            legend.visible = self.shading.value == ERROR
            self._changed()

        self.shading.on_update(chosen)
        self.bone.on_update(lambda _: self._changed())

    def _add_joints(self, name: str, choices: dict[str, tuple[int, ...]]) -> Callable[[], None]:
        """Add the sliders of one group; returns a function that sets them to the stored turns."""
        with self._gui.add_folder(name, expand_by_default=False):
            names = tuple(choices)
            first = "left shoulder" if "left shoulder" in choices else names[0]
            joint = self._gui.add_dropdown("Joint", names, initial_value=first)
            sliders = [
                self._gui.add_slider(f"Turn {axis} (°)", -_LARGEST_TURN, _LARGEST_TURN, 1.0, 0.0)
                for axis in _AXES
            ]

        def show() -> None:
            turn = self._turns.get(choices[joint.value][0], [0.0, 0.0, 0.0])
            for slider, value in zip(sliders, np.rad2deg(turn), strict=True):
                slider.value = float(np.clip(np.round(value), -_LARGEST_TURN, _LARGEST_TURN))

        def turn(event: Any) -> None:
            if event.client_id is None:  # set by `show`, not by the user
                return
            values = [float(np.deg2rad(slider.value)) for slider in sliders]
            for each in choices[joint.value]:
                self._turns[each] = list(values)
            self._changed()

        joint.on_update(lambda _: show())
        for slider in sliders:
            slider.on_update(turn)
        return show

    def _add_expression(self, count: int) -> list[Any]:
        with self._gui.add_folder("Expression", expand_by_default=False, visible=count > 0):
            sliders = [
                self._gui.add_slider(str(k), -_LARGEST_EXPRESSION, _LARGEST_EXPRESSION, 0.1, 0.0)
                for k in range(count)
            ]
        for slider in sliders:
            slider.on_update(lambda _: self._changed())
        return sliders
