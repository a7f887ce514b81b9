"""The same losses whether one device does a step or four share it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import jax
import numpy as np
import pytest
from xavatar_jax.training.devices import ONE_DEVICE, share_work

import xavatar_jax as xa
from xavatar_jax.files import save_arrays

RUN = """
import json, sys
from dataclasses import replace
import jax, jax.numpy as jnp, numpy as np
import xavatar_jax as xa
from small_runs import posed_frames, tiny
from xavatar_jax.fields import MLPShape
from xavatar_jax.files import load_arrays
from xavatar_jax.training import fresh_fields
from xavatar_jax.training.devices import share_work
from xavatar_jax.training.loop import train_pool
from xavatar_jax.training.pool import FramePool

body = xa.synthetic_body()
arrays, _ = load_arrays(sys.argv[1])
params = jax.tree.map(jnp.asarray, posed_frames(body, 3).params)
pool = FramePool(params=params, **{name: jnp.asarray(value) for name, value in arrays.items()})

def run(preset, frames_per_step, held):
    config = tiny(preset)
    config = replace(
        config, steps=6, report_every=1, polish_every=3, frames_per_step=frames_per_step,
        points_per_step=32, skinning_points=16,
        geometry=replace(config.geometry, mlp=MLPShape(width=48, depth=3, skip=()), log2_size=10),
        search=replace(config.search, keep=2, max_steps=8),
        validation=replace(config.validation, every=6, points=32),
    )
    fields = fresh_fields(body, config)
    result = {}
    for count in (1, 4):
        devices = share_work(config, jax.devices()[:count])
        done = train_pool(
            body, fields, pool, np.zeros(10), config, held=held, verbose=False, devices=devices
        )
        leaf = jax.tree.leaves(done.fields)[0]
        result[count] = {
            "mesh": None if devices.mesh is None else dict(devices.mesh.shape),
            "losses": done.history.terms["loss"], "validation": done.history.validation,
            "devices": len(leaf.devices()),
        }
    return result

search = replace(xa.quick().search, cached=False, guide_every=2)
found = {
    "quick": run(xa.quick(), 4, 1),
    "paper": run(xa.paper(), 2, 0),
    "guided": run(replace(xa.quick(), search=search), 2, 1),
}
third = share_work(xa.quick(), jax.devices()[2:3])
placed = third.replicate(jnp.ones(3))
found["third"] = [str(third.first), [str(d) for d in placed.devices()], third.count]
print("RESULT", json.dumps(found))
"""


@pytest.fixture(scope="module")
def results(case, tmp_path_factory) -> dict:
    """Losses of both presets, and of searches with a guide, in a process that sees four devices."""
    pool, here = case[4], Path(__file__).parent
    file = tmp_path_factory.mktemp("pool") / "pool.npz"
    leaves = {f.name: getattr(pool, f.name) for f in fields(pool) if f.name != "params"}
    save_arrays(file, {k: v for k, v in leaves.items() if v is not None}, {})
    environment = {
        **os.environ,
        "XLA_FLAGS": os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=4",
        "JAX_PLATFORMS": "cpu",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
        "PYTHONPATH": os.pathsep.join([str(here), str(Path(xa.__file__).parents[1])]),
    }
    done = subprocess.run(
        [sys.executable, "-c", RUN, str(file)], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.split("RESULT", 1)[1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("preset", "mesh"),
    [
        ("quick", {"frames": 4, "points": 1}),
        ("paper", {"frames": 2, "points": 2}),
        ("guided", {"frames": 2, "points": 2}),
    ],
)
def test_four_devices_give_the_losses_of_one(results, preset, mesh):
    """With stored roots, and with roots that each device searches for its own points."""
    one, four = results[preset]["1"], results[preset]["4"]
    assert one["mesh"] is None
    assert four["mesh"] == mesh
    assert one["devices"] == four["devices"] == 1  # what comes back is on one device
    np.testing.assert_allclose(four["losses"], one["losses"], rtol=1e-4)
    np.testing.assert_allclose(four["validation"], one["validation"], rtol=1e-4)


@pytest.mark.slow
def test_one_device_may_be_any(results):
    """Not the first of the machine alone."""
    first, placed, count = results["third"]
    assert placed == [first]
    assert first.endswith("2") or "id=2" in first
    assert count == 1


def test_one_device_is_left_as_it_is():
    config = xa.quick()
    assert share_work(config, jax.devices()[:1]) is ONE_DEVICE
    tree = {"a": np.arange(3), "b": "word"}
    assert ONE_DEVICE.replicate(tree) is tree
    assert ONE_DEVICE.agree(True)


def test_a_batch_that_cannot_be_divided_is_refused():
    config = replace(xa.quick(), frames_per_step=16, points_per_step=511)
    with pytest.raises(ValueError, match=r"16 frames of 511 points.*multiple of 3, or points_per"):
        share_work(config, [jax.devices()[0]] * 3)
