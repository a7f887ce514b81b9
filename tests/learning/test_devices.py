"""The same losses whether one device takes a step or four share it."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
import pytest
from helpers import run_as_user

from xavatar_jax.learning import ONE_DEVICE, share_work

RUN = """
import os
os.environ["XLA_FLAGS"] = "--xla_force_host_platform_device_count=4"
import json
from dataclasses import replace
import equinox as eqx, jax, jax.numpy as jnp, numpy as np
from toy_problem import HeldError, Line, Turn, line, points, stage
from xavatar_jax.learning import BY_FRAME, BY_POINT, Devices, Schedule, Validation
from xavatar_jax.learning import share_work, train

class Batch(eqx.Module):
    x: jax.Array
    y: jax.Array
    shift: jax.Array

class DrawFrames(eqx.Module):
    frames: int = eqx.field(static=True)
    devices: Devices = eqx.field(static=True)

    def __call__(self, model, data, key):
        rows = jax.random.randint(key, (self.frames, 8), 0, len(data.x) - 10)
        batch = Batch(data.x[rows], data.y[rows], jnp.arange(self.frames) / 10.0)
        specs = Batch(BY_POINT, BY_POINT, BY_FRAME)
        batch = self.devices.divide(batch, specs)
        # A search that each device makes for its own points.
        def halve(slope, own):
            return jax.lax.while_loop(lambda v: jnp.abs(v).max() > 1e-3, lambda v: v / 2, own.y)
        tiny = self.devices.apart(halve, model.slope, batch, specs)
        return replace(batch, y=batch.y + 0 * tiny)

class Error(eqx.Module):
    def __call__(self, model, batch, key):
        off = batch.x @ model.slope + model.offset + batch.shift[:, None] - batch.y
        return (off**2).mean()

def run(frames, devices):
    both = stage(learns=("slope", "offset"), draw=DrawFrames(frames, devices),
                 terms={"error": (1.0, Error())})
    done = train(
        line(), points(), [both], Schedule(6, report_every=1), upkeep=[Turn(3)],
        validation=Validation(HeldError(10), every=3), devices=devices, verbose=False,
    )
    return {
        "mesh": None if devices.mesh is None else dict(devices.mesh.shape),
        "losses": done.history.terms["loss"], "validation": done.history.validation,
        "devices": len(done.model.slope.devices()),
    }

found = {}
for name, frames in (("frames", 4), ("points", 2)):
    found[name] = [
        run(frames, share_work(frames, {"points": 8}, jax.devices()[:count])) for count in (1, 4)
    ]
third = share_work(4, {"points": 8}, jax.devices()[2:3])
placed = third.replicate(jnp.ones(3))
found["third"] = [str(third.first), [str(d) for d in placed.devices()], third.count]
print("RESULT", json.dumps(found))
"""


@pytest.fixture(scope="module")
def results():
    """Losses in a process that sees four devices."""
    return run_as_user(RUN, paths=(Path(__file__).parent,))


@pytest.mark.parametrize(
    ("by", "mesh"), [("frames", {"frames": 4, "points": 1}), ("points", {"frames": 2, "points": 2})]
)
def test_four_devices_give_the_losses_of_one(results, by, mesh):
    one, four = results[by]
    assert one["mesh"] is None
    assert four["mesh"] == mesh
    assert one["devices"] == four["devices"] == 1  # what comes back is on one device
    np.testing.assert_allclose(four["losses"], one["losses"], rtol=1e-4)
    np.testing.assert_allclose(four["validation"], one["validation"], rtol=1e-4)


def test_one_device_may_be_any(results):
    """Not only the first of the machine."""
    first, placed, count = results["third"]
    assert placed == [first]
    assert first.endswith("2") or "id=2" in first
    assert count == 1


def test_one_device_is_left_as_it_is():
    assert share_work(16, {"points_per_step": 512}, jax.devices()[:1]) is ONE_DEVICE
    tree = {"a": np.arange(3), "b": "word"}
    assert ONE_DEVICE.replicate(tree) is tree
    assert ONE_DEVICE.agree(True)


def test_a_batch_that_cannot_be_divided_is_refused():
    with pytest.raises(ValueError, match=r"16 frames of 511 points.*multiple of 3, or points_per"):
        share_work(16, {"points_per_step": 511}, [jax.devices()[0]] * 3)
