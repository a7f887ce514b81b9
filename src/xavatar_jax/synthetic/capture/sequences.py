"""The sequences of the bundled capture, as key poses.

Nine are for training: reaching, grasping, counting, gestures, turning on the spot, squats and
leg lifts, faces, drinking and telephoning, lifting a box. Three are held out; their hand shapes
and body poses do not occur in training.
"""

from __future__ import annotations

from .keys import Arm, Foot, Gaze, Key, Pelvis, Torso, sequence

# Expression coefficients of the bundled body.
SMILE, OPEN, BROWS_UP, FROWN, POUT, PUFF, WIDE, NOSE, SQUINT, SMIRK = range(10)

_DOWN = Arm()
_READY = Arm(-8, -50, 0.66, palm=10)


def _reaching() -> list[Key]:
    return sequence(
        {"both": _DOWN, "hands": "relaxed"},
        {
            "seconds": 0.8, "right": Arm(4, 2, 0.97, palm=-40), "right_hand": "flat",
            "torso": Torso(8, 0, 14), "gaze": Gaze(-2, -4), "pelvis": Pelvis(0.02, -0.01, 0.03),
        },
        {
            "seconds": 0.8, "right": Arm(85, 12, 0.95, palm=-20), "right_hand": "spread",
            "torso": Torso(2, -8, -22), "gaze": Gaze(-45, 0), "pelvis": Pelvis(-0.03, -0.01),
        },
        {
            "seconds": 0.9, "right": Arm(30, 78, 0.97, palm=10), "right_hand": "flat",
            "torso": Torso(-6, 8, -4), "gaze": Gaze(-10, 30), "pelvis": Pelvis(0.0, 0.0),
        },
        {
            "seconds": 0.8, "right": _DOWN, "right_hand": "relaxed",
            "left": Arm(-38, -5, 0.86, palm=-30), "left_hand": "flat",
            "torso": Torso(10, 0, -24), "gaze": Gaze(-30, -8),
        },
        {
            "seconds": 0.8, "left": Arm(100, 25, 0.95, palm=20), "left_hand": "spread",
            "torso": Torso(0, 10, 24), "gaze": Gaze(50, 10), "pelvis": Pelvis(0.03, -0.01),
        },
        {
            "seconds": 0.9, "left": Arm(10, -40, 0.97, palm=-60), "left_hand": "relaxed",
            "right": Arm(18, -38, 0.96, palm=-50), "right_hand": "spread",
            "torso": Torso(48, 0, 0), "gaze": Gaze(0, -20),
            "pelvis": Pelvis(0, -0.06, -0.10, lean=28),
        },
        {
            "seconds": 1.0, "both": Arm(25, 55, 0.95), "hands": "flat", "torso": Torso(-10, 0, 0),
            "gaze": Gaze(0, 28), "pelvis": Pelvis(),
        },
    )  # fmt: skip


def _grasping() -> list[Key]:
    front, low, high = Arm(2, -28, 0.74, palm=0), Arm(14, -48, 0.8), Arm(20, 8, 0.78, 10)
    return sequence(
        {"both": _READY, "hands": "relaxed", "gaze": Gaze(0, -25)},
        {"seconds": 0.7, "right": front, "right_hand": "power", "left_hand": "flat"},
        {"seconds": 0.7, "left": low, "left_hand": "pinch", "gaze": Gaze(12, -28)},
        {
            "seconds": 0.7, "right": Arm(-12, -18, 0.66, palm=50, bend=20), "right_hand": "lateral",
            "torso": Torso(8, 0, 8), "gaze": Gaze(0, -20),
        },
        {"seconds": 0.7, "left": high, "left_hand": "cylinder", "gaze": Gaze(15, -5)},
        {
            "seconds": 0.7, "right": Arm(22, -66, 0.93), "right_hand": "hook",
            "left": Arm(-4, -22, 0.7, palm=-45), "left_hand": "spread",
        },
        {"seconds": 0.7, "right": front, "right_hand": "pinch", "left_hand": "power"},
        {
            "seconds": 0.7, "left": Arm(4, -24, 0.72, palm=60), "left_hand": "fist",
            "right": Arm(16, -30, 0.78, palm=-50, tilt=-12), "right_hand": "cylinder",
        },
        {
            "seconds": 0.6, "left_hand": "lateral", "right_hand": "fist",
            "right": Arm(10, -10, 0.7, palm=30, bend=-25),
        },
        {"seconds": 0.8, "left": _DOWN, "left_hand": "hook", "right_hand": "spread"},
    )  # fmt: skip


def _counting() -> list[Key]:
    right = Arm(28, 14, 0.56, palm=-35, bend=-8)
    left = Arm(26, 10, 0.58, palm=-30, bend=-8)
    return sequence(
        {"right": right, "left": _DOWN, "right_hand": "fist", "talk": 0.6, "gaze": Gaze(-8, -2)},
        {"seconds": 0.55, "right_hand": "point"},
        {"seconds": 0.55, "right_hand": "two", "gaze": Gaze(4, 0)},
        {"seconds": 0.55, "right_hand": "three", "face": {SMILE: 0.8}},
        {"seconds": 0.55, "right_hand": "four", "left": left, "left_hand": "fist"},
        {"seconds": 0.55, "right_hand": "spread", "gaze": Gaze(6, -3)},
        {"seconds": 0.6, "left_hand": "point", "right": Arm(24, 4, 0.6, palm=-20)},
        {"seconds": 0.55, "left_hand": "two", "face": {BROWS_UP: 0.9}},
        {"seconds": 0.55, "left_hand": "three", "left": Arm(30, 18, 0.6, palm=-40, bend=-12)},
        {"seconds": 0.55, "left_hand": "four", "gaze": Gaze(10, 2, 5)},
        {"seconds": 0.6, "left_hand": "spread", "face": {SMILE: 1.4}},
        {"seconds": 0.6, "hands": "relaxed", "both": Arm(10, -50, 0.8), "talk": 0.0},
    )


def _gestures() -> list[Key]:
    wave = Arm(50, 28, 0.62, palm=-45, bend=-10)
    return sequence(
        {"both": _DOWN, "face": {SMILE: 0.6}},
        {"seconds": 0.6, "right": wave, "right_hand": "spread", "gaze": Gaze(-12, 3)},
        {"seconds": 0.35, "right": wave._replace(azimuth=75, tilt=16)},
        {"seconds": 0.35, "right": wave._replace(azimuth=42, tilt=-12), "face": {SMILE: 1.5}},
        {"seconds": 0.35, "right": wave._replace(azimuth=72, tilt=14)},
        {
            "seconds": 0.7, "right": Arm(-5, -12, 0.66, palm=5), "right_hand": "thumbs_up",
            "left": Arm(10, -58, 0.8), "left_hand": "fist", "face": {BROWS_UP: 0.8, SMILE: 1.0},
        },
        {
            "seconds": 0.7, "right": Arm(-8, 4, 0.97, palm=-35), "right_hand": "point",
            "gaze": Gaze(2, 4), "torso": Torso(4, 0, 12), "face": {FROWN: 0.6},
        },
        {
            "seconds": 0.7, "left": Arm(24, 2, 0.62, palm=-35), "left_hand": "ok",
            "right": _DOWN, "right_hand": "relaxed", "torso": Torso(), "face": {SMIRK: 1.2},
        },
        {  # a shrug
            "seconds": 0.7, "both": Arm(48, -42, 0.72, palm=75), "hands": "flat",
            "gaze": Gaze(0, 4, 14), "face": {BROWS_UP: 1.4, POUT: 0.8},
        },
        {
            "seconds": 0.7, "left": Arm(80, 6, 0.96, palm=-20), "left_hand": "point",
            "right": Arm(20, -65, 0.9), "gaze": Gaze(50, 3), "torso": Torso(0, 0, 18),
        },
        {
            "seconds": 0.8, "both": Arm(-24, -30, 0.52, palm=20), "hands": "flat",
            "gaze": Gaze(0, -10), "torso": Torso(12), "face": {SMILE: 1.0},
        },
    )  # fmt: skip


def _turning() -> list[Key]:
    # Each step lifts one foot, rotates it and sets it down; the pelvis follows.
    keys = [Key(left=Arm(14, -74, 0.93), right=Arm(14, -74, 0.93))]
    yaw, radius = 0.0, 0.12
    import math

    def foot(side: float, at: float, up: float = 0.0) -> Foot:
        turned = math.radians(at)
        return Foot(
            side * radius * math.cos(turned), up, -side * radius * math.sin(turned), at + 6 * side
        )

    step = 50.0
    for i in range(5):
        mid, end = yaw + step / 2, yaw + step
        swing = 1 if i % 2 else -1
        keys.append(
            keys[-1].then(
                0.32, left_foot=foot(1.0, mid, 0.07), pelvis=Pelvis(-0.035, -0.02, 0, mid - 8),
                left=Arm(14 - 26 * swing, -70, 0.9), right=Arm(14 + 26 * swing, -70, 0.9),
                gaze=Gaze(22, -4), torso=Torso(3, 0, 10),
            )
        )  # fmt: skip
        keys.append(keys[-1].then(0.24, left_foot=foot(1.0, end), pelvis=Pelvis(0, -0.02, 0, mid)))
        keys.append(
            keys[-1].then(
                0.30, right_foot=foot(-1.0, mid, 0.07), pelvis=Pelvis(0.035, -0.02, 0, end - 8),
                gaze=Gaze(8, 0), left=Arm(14 + 20 * swing, -68, 0.85),
                right=Arm(14 - 20 * swing, -68, 0.88),
            )
        )  # fmt: skip
        keys.append(
            keys[-1].then(0.24, right_foot=foot(-1.0, end), pelvis=Pelvis(0, -0.02, 0, end))
        )
        yaw = end
    keys.append(keys[-1].then(0.6, both=_DOWN, gaze=Gaze(), torso=Torso()))
    return keys


def _squats_and_leg_lifts() -> list[Key]:
    arms = Arm(4, 0, 0.95, palm=-40)
    wide = {"left_foot": Foot(0.17, yaw=18), "right_foot": Foot(-0.17, yaw=-18)}
    squat = {
        "pelvis": Pelvis(0, -0.40, -0.16, lean=30), "torso": Torso(16), "gaze": Gaze(0, 22),
        "left_foot": Foot(0.17, yaw=18, out=14), "right_foot": Foot(-0.17, yaw=-18, out=14),
    }  # fmt: skip
    stand = {"pelvis": Pelvis(0, -0.015), "torso": Torso(), "gaze": Gaze(), **wide}
    return sequence(
        {"both": _DOWN, **wide},
        {"seconds": 0.9, "both": arms, "hands": "flat", **squat},
        {"seconds": 0.7, "both": Arm(20, -50, 0.92), "hands": "fist", **stand},
        {  # left knee up
            "seconds": 0.7, "left": Arm(30, -40, 0.8), "right": Arm(40, -30, 0.85),
            "hands": "relaxed", "pelvis": Pelvis(-0.13, -0.02, 0, 0, -4, -3),
            "left_foot": Foot(0.12, 0.46, 0.24, yaw=4, heel=20), "right_foot": Foot(-0.13),
        },
        {"seconds": 0.7, **stand, "both": _DOWN},
        {  # right leg out
            "seconds": 0.7, "both": Arm(70, -22, 0.93), "pelvis": Pelvis(0.14, -0.02, 0, 0, 0, 6),
            "right_foot": Foot(-0.58, 0.24, 0.02, yaw=-12, heel=12), "left_foot": Foot(0.13),
            "torso": Torso(0, 6),
        },
        {"seconds": 0.7, **stand, "both": Arm(20, -55, 0.8)},
        {  # left leg back
            "seconds": 0.7, "both": Arm(15, -12, 0.9, palm=-30), "torso": Torso(14),
            "pelvis": Pelvis(-0.11, -0.03, 0.02, 0, 14), "right_foot": Foot(-0.12),
            "left_foot": Foot(0.13, 0.16, -0.48, heel=48),
        },
        {"seconds": 0.7, **stand, "both": _DOWN},
        {"seconds": 0.8, **squat, "both": Arm(-10, -26, 0.55, palm=20), "hands": "power"},
        {"seconds": 0.6, **stand, "both": _DOWN, "hands": "relaxed"},
    )  # fmt: skip


def _faces() -> list[Key]:
    return sequence(
        {"both": Arm(14, -66, 0.86)},
        {"seconds": 0.6, "face": {SMILE: 2.0, SQUINT: 0.8}, "gaze": Gaze(18, 4)},
        {"seconds": 0.6, "face": {OPEN: 1.6, BROWS_UP: 2.0}, "jaw": 16.0, "gaze": Gaze(-10, 10)},
        {"seconds": 0.6, "face": {FROWN: 2.0, NOSE: 1.4, POUT: 0.6}, "jaw": 1.0,
         "gaze": Gaze(-20, -10, -6), "both": Arm(24, -50, 0.62), "hands": "fist"},
        {"seconds": 0.6, "face": {POUT: 2.0, BROWS_UP: 0.6}, "gaze": Gaze(0, 0, 12)},
        {"seconds": 0.6, "face": {PUFF: 2.0}, "gaze": Gaze(10, -4, -8), "hands": "relaxed"},
        {"seconds": 0.6, "face": {WIDE: 1.8, SQUINT: 1.2}, "jaw": 7.0, "talk": 0.4},
        {"seconds": 0.7, "face": {SMIRK: 2.0}, "jaw": 2.0, "talk": 0.9, "gaze": Gaze(-28, 2, 4),
         "right": Arm(26, -26, 0.62, palm=40), "right_hand": "box"},
        {"seconds": 0.7, "face": {SMILE: 0.8, BROWS_UP: 1.0}, "talk": 1.0, "gaze": Gaze(30, 8, -6),
         "left": Arm(34, -18, 0.66, palm=50), "left_hand": "flat"},
        {"seconds": 0.6, "face": {OPEN: 2.0, SQUINT: 1.6}, "jaw": 22.0, "talk": 0.0,
         "gaze": Gaze(0, 24)},
        {"seconds": 0.6, "face": {SMILE: -1.2, FROWN: 1.0}, "jaw": 0.0, "gaze": Gaze(0, -26),
         "both": Arm(14, -62, 0.86)},
    )  # fmt: skip


def _drink_and_phone() -> list[Key]:
    mouth = Arm(-27, 12, 0.50, elbow=22, palm=6, bend=4)
    ear = Arm(42, 43, 0.42, elbow=8, palm=-8, bend=8)
    return sequence(
        {"both": _DOWN, "gaze": Gaze(-6, -20)},
        {"seconds": 0.8, "right": Arm(8, -32, 0.82), "right_hand": "spread"},
        {"seconds": 0.4, "right_hand": "cylinder"},
        {"seconds": 0.8, "right": mouth, "gaze": Gaze(0, 4), "face": {POUT: 1.0}, "jaw": 4.0},
        {"seconds": 0.6, "right": mouth._replace(tilt=20, height=16, palm=20),
         "gaze": Gaze(0, 16)},
        {"seconds": 0.7, "right": Arm(8, -32, 0.80), "gaze": Gaze(-4, -16), "jaw": 1.0, "face": {}},
        {"seconds": 0.7, "right": _DOWN, "right_hand": "relaxed",
         "left": Arm(4, -30, 0.72, palm=40), "left_hand": "phone"},
        {"seconds": 0.7, "left": ear, "gaze": Gaze(8, 0, 8), "talk": 0.9},
        {"seconds": 0.7, "gaze": Gaze(-14, 4, 6), "right": Arm(16, -46, 0.7, palm=30),
         "right_hand": "relaxed"},
        {"seconds": 0.8, "left": Arm(-10, -30, 0.6, palm=50), "talk": 0.0, "gaze": Gaze(6, -26),
         "right": Arm(-16, -36, 0.58, palm=-20), "right_hand": "point"},
    )  # fmt: skip


def _box() -> list[Key]:
    hold = Arm(4, -28, 0.66, palm=18)
    feet = {"left_foot": Foot(0.17, yaw=12), "right_foot": Foot(-0.17, yaw=-12)}
    bent = Pelvis(0, -0.30, -0.22, lean=40)
    return sequence(
        {"both": _DOWN, **feet, "gaze": Gaze(0, -24)},
        {"seconds": 0.5, "both": Arm(14, -24, 0.9, palm=10), "hands": "flat",
         "pelvis": Pelvis(0, -0.10, -0.08, lean=14), "torso": Torso(14)},
        {"seconds": 0.7, "both": Arm(12, -8, 0.95, palm=10), "hands": "box", "pelvis": bent,
         "torso": Torso(38), "gaze": Gaze(0, 4),
         "left_foot": Foot(0.17, yaw=12, out=10), "right_foot": Foot(-0.17, yaw=-12, out=10)},
        {"seconds": 0.5, "both": Arm(9, -8, 0.94, palm=14), "face": {FROWN: 0.8, SQUINT: 0.6}},
        {"seconds": 0.5, "both": Arm(12, -8, 0.92, palm=14), "torso": Torso(22),
         "pelvis": Pelvis(0, -0.16, -0.10, lean=18)},
        {"seconds": 0.7, "both": hold, "pelvis": Pelvis(0, -0.02), "torso": Torso(-4), **feet,
         "gaze": Gaze(0, -12), "face": {PUFF: 0.8}},
        {"seconds": 0.8, "torso": Torso(0, 2, 34), "gaze": Gaze(20, -8),
         "pelvis": Pelvis(0.04, -0.02, 0, 14)},
        {"seconds": 0.8, "torso": Torso(0, 0, -20), "gaze": Gaze(-12, 0),
         "pelvis": Pelvis(-0.03, -0.02, 0, -8), "both": hold._replace(height=-16)},
        {"seconds": 1.0, "both": Arm(3, 38, 0.86, palm=14), "torso": Torso(-8), "pelvis": Pelvis(),
         "gaze": Gaze(0, 26), "face": {}},
        {"seconds": 0.8, "both": Arm(20, -30, 0.8), "hands": "relaxed", "gaze": Gaze(0, 0)},
    )  # fmt: skip


def _inspect_and_pass() -> list[Key]:
    return sequence(
        {"both": _READY, "hands": "sphere", "gaze": Gaze(0, -26)},
        {"seconds": 0.7, "right": Arm(-18, 2, 0.58, palm=62, bend=25), "right_hand": "sphere",
         "left": Arm(-6, -44, 0.56, palm=-30), "left_hand": "tripod", "torso": Torso(6, -8, -10),
         "gaze": Gaze(-8, -12, -10), "face": {SQUINT: 1.4, FROWN: 0.8}},
        {"seconds": 0.7, "right": Arm(-10, 20, 0.52, palm=-50, bend=30), "right_hand": "duck",
         "torso": Torso(-6, 6, -6), "gaze": Gaze(-6, 14), "face": {OPEN: 1.0, SQUINT: 1.2}},
        {"seconds": 0.7, "left": Arm(30, -10, 0.86, palm=70, bend=-20), "left_hand": "claw",
         "right": Arm(60, -38, 0.78, palm=55), "right_hand": "tripod", "torso": Torso(14, 10, 16),
         "pelvis": Pelvis(0.05, -0.05, 0.02, 12), "gaze": Gaze(24, -10)},
        {"seconds": 0.7, "left": Arm(70, 34, 0.7, palm=64), "left_hand": "sphere",
         "right": Arm(-40, -18, 0.62, palm=-30), "right_hand": "claw",
         "torso": Torso(4, -12, 26), "gaze": Gaze(44, 18, 8), "face": {WIDE: 1.4, BROWS_UP: 1.0}},
        {"seconds": 0.8, "right": Arm(-30, 30, 0.82, palm=30), "right_hand": "sphere",
         "left": Arm(110, -30, 0.86), "left_hand": "duck", "torso": Torso(6, 4, 30)},
    )  # fmt: skip


def _lunge_and_throw() -> list[Key]:
    lunge = {"left_foot": Foot(0.10, 0, 0.42, yaw=4), "right_foot": Foot(-0.13, 0, -0.26, -16, 34)}
    return sequence(
        {"both": _DOWN, "hands": "gun"},
        {"seconds": 0.5, "left_foot": Foot(0.1, 0.10, 0.24), "pelvis": Pelvis(-0.05, -0.04, 0.04),
         "left": Arm(20, -10, 0.9), "right": Arm(80, -10, 0.8)},
        {"seconds": 0.5, **lunge, "pelvis": Pelvis(0, -0.27, 0.12, lean=8),
         "left": Arm(8, 22, 0.92, palm=-55), "left_hand": "claw",
         "right": Arm(125, 34, 0.6, palm=-40), "right_hand": "sphere", "torso": Torso(-10, 6, -28),
         "gaze": Gaze(22, 8), "face": {NOSE: 1.2, FROWN: 1.0}, "jaw": 6.0},
        {"seconds": 0.5, "right": Arm(-16, 14, 0.95, palm=-60, bend=30), "right_hand": "gun",
         "left": Arm(100, -38, 0.8), "left_hand": "shaka", "torso": Torso(18, 0, 24),
         "gaze": Gaze(-14, 6), "face": {OPEN: 1.6, NOSE: 1.0}, "jaw": 18.0},
        {"seconds": 0.4, "left_foot": Foot(0.12, 0.07, 0.22),
         "pelvis": Pelvis(-0.05, -0.16, -0.04)},
        {"seconds": 0.4, "left_foot": Foot(0.13, 0, 0.05), "pelvis": Pelvis(0.06, -0.08, 0),
         "right_foot": Foot(-0.14, 0.05, -0.13, -12)},
        {"seconds": 0.4, "right_foot": Foot(-0.15, 0, -0.02, -8),
         "pelvis": Pelvis(0, -0.03, 0), "both": Arm(62, 50, 0.66, palm=30), "hands": "shaka",
         "torso": Torso(-12, 10, 0), "gaze": Gaze(0, 16, 10), "face": {SMILE: 2.0, WIDE: 1.0},
         "jaw": 10.0},
        {"seconds": 0.4, "right_foot": Foot(-0.30, 0.07, 0.0, -16),
         "pelvis": Pelvis(0.03, -0.05, 0, -2, 4), "both": Arm(95, 14, 0.8)},
        {"seconds": 0.6, "right_foot": Foot(-0.46, 0, 0.0, -24),
         "pelvis": Pelvis(-0.22, -0.14, 0, -6, 10, -4), "both": Arm(118, -20, 0.9),
         "hands": "horns", "torso": Torso(22, -16, -12), "gaze": Gaze(-30, 4)},
    )  # fmt: skip


def _signs_and_piano() -> list[Key]:
    play = Arm(14, -34, 0.68, palm=-75, bend=6)
    return sequence(
        {"both": play, "hands": "keys", "gaze": Gaze(0, -30), "face": {FROWN: 0.4, POUT: 1.2}},
        {"seconds": 0.5, "left": Arm(34, -36, 0.76, palm=-78, bend=-6), "left_hand": "claw",
         "right": Arm(-6, -34, 0.66, palm=-75), "torso": Torso(10, 0, 8), "gaze": Gaze(18, -26)},
        {"seconds": 0.5, "left_hand": "duck", "right_hand": "claw", "torso": Torso(14, -8, -6),
         "right": Arm(40, -34, 0.82, palm=-78, bend=10), "gaze": Gaze(-22, -24, -6)},
        {"seconds": 0.6, "right": Arm(38, 26, 0.48, palm=-20, bend=-14), "right_hand": "horns",
         "left": Arm(-20, -12, 0.5, palm=-60, bend=22), "left_hand": "keys",
         "face": {SMILE: 1.2, NOSE: 1.2}, "gaze": Gaze(0, 6), "talk": 0.8},
        {"seconds": 0.6, "right": Arm(10, 10, 0.5, palm=55, tilt=-14), "right_hand": "shaka",
         "left": Arm(38, 24, 0.5, palm=-45, bend=-16), "left_hand": "horns",
         "face": {SMIRK: 1.6, BROWS_UP: 1.6}, "jaw": 9.0},
        {"seconds": 0.6, "right": Arm(-12, 26, 0.56, palm=-70, bend=-30), "right_hand": "duck",
         "left": Arm(64, -8, 0.56, palm=70, bend=30), "left_hand": "gun",
         "torso": Torso(-4, 12, 12), "gaze": Gaze(12, 10, 12)},
        {"seconds": 0.8, "both": Arm(84, 40, 0.52, palm=-30), "hands": "claw",
         "torso": Torso(-10), "gaze": Gaze(0, 20), "face": {WIDE: 1.4, OPEN: 1.2}, "jaw": 20.0},
    )  # fmt: skip


TRAIN_SEQUENCES = {
    "reach_around": _reaching,
    "grasp_shapes": _grasping,
    "count_fingers": _counting,
    "gestures": _gestures,
    "turn_and_step": _turning,
    "squat_and_lift_legs": _squats_and_leg_lifts,
    "faces_and_talk": _faces,
    "drink_and_phone": _drink_and_phone,
    "lift_box": _box,
}
TEST_SEQUENCES = {
    "inspect_and_pass": _inspect_and_pass,
    "lunge_and_throw": _lunge_and_throw,
    "signs_and_piano": _signs_and_piano,
}
