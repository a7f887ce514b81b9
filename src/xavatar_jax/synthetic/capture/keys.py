"""Key poses, from which sequences are composed."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple


class Arm(NamedTuple):
    """Position and orientation of a hand, in degrees, relative to its own side of the body.

    Attributes:
        azimuth: direction from the shoulder to the wrist: 0 forwards, 90 out to the side,
            negative across the body, beyond 90 behind.
        height: the same direction, up from the horizontal: -90 hangs down, 90 points up.
        extent: distance of the wrist from the shoulder, as a fraction of the arm's length.
        elbow: rotates the elbow about that line, outwards and up from its natural position.
        palm: rotates the palm about the forearm from thumb up (with the elbow bent): positive
            turns the palm up, negative down.
        bend: bends the wrist towards the palm.
        tilt: bends the wrist towards the thumb.
    """

    azimuth: float = 55.0
    height: float = -73.0
    extent: float = 0.95
    elbow: float = 0.0
    palm: float = 0.0
    bend: float = 0.0
    tilt: float = 0.0


class Torso(NamedTuple):
    """Bending of the spine as a whole, degrees: forwards, to the left, and turning left."""

    forward: float = 2.0
    left: float = 0.0
    turn: float = 0.0


class Gaze(NamedTuple):
    """Direction of the face against the chest, degrees: turned left, up, tilted to the left."""

    left: float = 0.0
    up: float = 0.0
    tilt: float = 0.0


class Pelvis(NamedTuple):
    """Position of the pelvis, metres left, up and forwards of its start; rotation in degrees."""

    left: float = 0.0
    up: float = 0.0
    forward: float = 0.0
    yaw: float = 0.0
    lean: float = 0.0
    roll: float = 0.0


class Foot(NamedTuple):
    """Position of the ball of a foot in the world, metres; rotation in degrees.

    Attributes:
        left, forward: position on the floor, relative to the start of the sequence.
        up: height above the floor.
        yaw: turned left, in the world.
        heel: raises the heel about the ball of the foot; negative raises the toes.
        out: turns the knee outwards.
    """

    left: float
    up: float = 0.0
    forward: float = 0.0
    yaw: float = 0.0
    heel: float = 0.0
    out: float = 0.0


STANDING = (Foot(0.11, yaw=6.0), Foot(-0.11, yaw=-6.0))

_ARM, _TORSO, _GAZE, _PELVIS = Arm(), Torso(), Gaze(), Pelvis()


@dataclass(frozen=True)
class Key:
    """One key pose. `then` creates the next one, keeping what is not given.

    Attributes:
        time: seconds.
        left, right: arms.
        left_hand, right_hand: names of hand shapes.
        torso, gaze, pelvis: see their classes.
        left_foot, right_foot: feet.
        face: expression coefficients by index.
        jaw: opening of the mouth, degrees.
        talk: 0 to 1, amplitude of additional mouth motion.
    """

    time: float = 0.0
    left: Arm = _ARM
    right: Arm = _ARM
    left_hand: str = "relaxed"
    right_hand: str = "relaxed"
    torso: Torso = _TORSO
    gaze: Gaze = _GAZE
    pelvis: Pelvis = _PELVIS
    left_foot: Foot = STANDING[0]
    right_foot: Foot = STANDING[1]
    face: dict[int, float] = field(default_factory=dict)
    jaw: float = 1.0
    talk: float = 0.0

    def then(self, seconds: float, *, both: Arm | None = None, hands: str | None = None, **changes):
        """The key `seconds` later. `both` and `hands` set both sides."""
        if both is not None:
            changes |= {"left": both, "right": both}
        if hands is not None:
            changes |= {"left_hand": hands, "right_hand": hands}
        return replace(self, time=self.time + seconds, **changes)


def sequence(*steps: dict) -> list[Key]:
    """Keys from changes: each step is the arguments of `Key.then`, the first at time zero."""
    keys = [Key().then(0.0, **steps[0])]
    for step in steps[1:]:
        keys.append(keys[-1].then(**step))
    return keys
