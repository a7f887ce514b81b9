"""Loss terms of one's own: added with their weights, named in the record, each with its key."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from xavatar_jax.training.objective import check_terms, with_extra


def known(fields, batch, anchors, config, key):
    return (fields**2).sum(), {"occupancy": (fields**2).sum()}


def test_terms_are_added_with_their_weights():
    terms = {
        "mean": (3.0, lambda fields, batch, key: fields.mean()),
        "cubes": (0.5, lambda fields, batch, key: (batch * fields**3).sum()),
    }
    objective = with_extra(known, terms, "skinning_")
    x, y = np.array([1.0, -2.0, 0.5], np.float32), np.float32(2.0)
    (total, record), slope = jax.value_and_grad(objective, has_aux=True)(
        jnp.asarray(x), y, None, None, jax.random.key(0)
    )
    np.testing.assert_allclose(total, (x**2).sum() + 3 * x.mean() + 0.5 * (y * x**3).sum(), 1e-5)
    np.testing.assert_allclose(slope, 2 * x + 1 + 1.5 * y * x**2, rtol=1e-5)
    assert set(record) == {"occupancy", "skinning_mean", "skinning_cubes"}
    np.testing.assert_allclose(record["skinning_mean"], x.mean(), rtol=1e-6)


def test_each_term_draws_for_itself():
    draw = (1.0, lambda fields, batch, key: jax.random.uniform(key))
    objective = with_extra(known, {"a": draw, "b": draw}, "")
    _, record = objective(jnp.zeros(3), 0.0, None, None, jax.random.key(0))
    assert float(record["a"]) != float(record["b"])


def test_without_terms_the_objective_is_itself():
    assert with_extra(known, {}, "") is known


@pytest.mark.parametrize("name", ["loss", "occupancy", "skinning_surface", "validation"])
def test_names_of_the_library_are_refused(name):
    with pytest.raises(ValueError, match=name):
        check_terms({name: (1.0, lambda fields, batch, key: jnp.zeros(()))})
