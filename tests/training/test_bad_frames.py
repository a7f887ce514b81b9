"""Frames that are wrong, poor or few: what is said, and that training copes."""

from __future__ import annotations

import gc
import warnings
import weakref
from dataclasses import replace

import jax
import numpy as np
import pytest
from small_runs import posed_frames, tiny
from xavatar_jax.training import TrainingNotice, choose_frames, loop
from xavatar_jax.training.check import FrameCheck, check_expression, check_found
from xavatar_jax.training.pool import label_frames
from xavatar_jax.training.progress import progress

import xavatar_jax as xa
from xavatar_jax.geometry import winding_number

ASIDE = np.array([2.0, 0.0, 0.0])


def labelled(body, frames):
    with progress("", len(frames), verbose=False) as bar:
        return label_frames(body, frames, tiny(xa.quick()), bar=bar)


def with_meshes(frames, change):
    """The same parameters with each mesh `(vertices, faces)` changed by its number."""
    meshes = [change(k, f.vertices, f.faces) for k, f in enumerate(frames)]
    names = [f"scan_{k}" for k in range(len(meshes))]
    return xa.Frames.from_meshes(meshes, frames.params, sources=names)


def sphere(centre, radius):
    """A closed mesh of latitudes and longitudes, faces outwards."""
    theta, phi = np.meshgrid(np.linspace(0, np.pi, 13), np.linspace(0, 2 * np.pi, 24, False))
    xyz = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
    vertices = np.stack(xyz, -1).reshape(-1, 3) * radius + centre
    index = np.arange(24 * 13).reshape(24, 13)
    a, b = index[:, :-1], np.roll(index, -1, 0)[:, :-1]
    c, d = np.roll(index, -1, 0)[:, 1:], index[:, 1:]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, d, c), (a, c, b))])
    return vertices, faces


def joined(first, second):
    return (
        np.concatenate([first[0], second[0]]),
        np.concatenate([first[1], second[1] + len(first[0])]),
    )


def wrong_labels(pool, frames, ok=None):
    """Share of labels that differ from the whole body's own winding number, 3 mm around apart."""
    wrong = []
    for k, frame in enumerate(frames):
        points = np.asarray(pool.points[k], np.float64)
        inside = winding_number(frame.vertices, frame.faces, points) > 0.5
        distance = np.asarray(pool.distance[k])
        clear = np.abs(distance) > 0.003
        if ok is not None:
            clear &= ok(points)
        wrong.append(((distance > 0) != inside)[clear].mean())
    return max(wrong)


def test_frames_that_do_not_fit_are_named(case):
    body, frames, *_ = case
    shifted = with_meshes(frames, lambda k, v, f: (v + np.array([0.2 * (k == 1), 0, 0]), f))
    with pytest.warns(TrainingNotice, match=r"1 of 3 frames do not fit.*scan_1 \(\d+\.\d cm\)\."):
        labelled(body, shifted)


def test_frames_within_three_centimetres_are_taken_without_a_word(case):
    body, frames, *_ = case
    labelled(body, with_meshes(frames, lambda k, v, f: (v + np.array([0.02, 0, 0]), f)))


def test_many_misfits_are_counted_and_the_worst_are_listed(case):
    found = [(f"f{k}", 0.01 * k) for k in range(12)]
    with pytest.warns(TrainingNotice, match=r"12 of 40 .* f11 \(11\.0 cm\).*f4 .* and 4 more\."):
        FrameCheck(case[0], misfits=found, seen=40).notify([])


def test_meshes_inside_out_are_turned_round(case):
    body, frames, *_ = case
    flipped = with_meshes(frames, lambda k, v, f: (v, f[:, ::-1] if k == 2 else f))
    with pytest.warns(TrainingNotice, match=r"1 of 3 meshes were inside out .*: scan_2\."):
        pool = labelled(body, flipped)
    assert wrong_labels(pool, frames) == 0


def test_holes_and_several_components(case):
    """A hole in the back, a loose piece far away, and a closed piece inside the chest."""
    body, frames, *_ = case
    at = frames[0].vertices[:, 1].argsort()[len(frames[0].vertices) // 2]

    def harm(k, vertices, faces):
        near = np.linalg.norm(vertices - vertices[at], axis=1) < 0.02
        torn = vertices, faces[~near[faces].any(1)]
        assert 10 < near.sum() < 0.05 * len(vertices)
        chest = vertices[np.asarray(body.weights)[:, body.tree.index("spine3")].argmax()]
        torn = joined(torn, sphere(vertices.mean(0) + ASIDE, 0.1))
        return joined(torn, sphere(np.append(frames[k].vertices.mean(0)[:2], chest[2]), 0.01))

    pool = labelled(body, with_meshes(frames, harm))

    def away(points):
        whole = frames[0].vertices
        return (np.abs(points - whole.mean(0)).max(1) < 1.5) & (
            np.min([np.linalg.norm(points - f.vertices[at], axis=1) for f in frames], axis=0) > 0.06
        )

    assert wrong_labels(pool, frames, away) < 0.005
    # Points drawn around the loose piece know it as a solid of its own.
    loose = np.asarray(pool.points[0]) - (frames[0].vertices.mean(0) + ASIDE)
    radius = np.linalg.norm(loose, axis=1)
    assert (np.asarray(pool.distance[0])[radius < 0.09] > 0).all()


def test_constant_poses(case):
    """Frames all alike are still so many frames."""
    body, _, config, _, _ = case
    frames = posed_frames(body, 20, constant=True)
    learned, held = choose_frames(frames, replace(config, train_frames=5))
    assert len(set(learned)) == 5
    assert list(held) == [18, 19]


def test_notices_are_kept_with_the_run(case, no_prefit, tmp_path):
    """In its history, and in that of a run that goes on from its checkpoint."""
    body, frames, config, _, _ = case
    moved = np.array([0.12, 0, 0])
    wrong = with_meshes(frames, lambda k, v, f: (v + moved * (k == 1), f[:, ::-1] if k else f))
    kept = {"checkpoint": tmp_path / "run.npz", "body": body, "verbose": False}
    config = replace(config, steps=1)  # all is said before it
    with pytest.warns(TrainingNotice) as said:
        done = xa.fit(wrong, config, **kept)
    messages = [str(w.message) for w in said]
    assert [m.split(" were ")[0].split(" do ")[0] for m in messages] == [
        "1 of 3 frames", "2 of 3 meshes",
    ]  # fmt: skip
    assert done.history.notices == messages
    again = xa.fit(wrong, config, resume=True, **kept)
    assert again.history.notices == messages


def test_a_single_frame(case, no_prefit):
    body, frames, config, _, _ = case
    done = xa.fit(frames[:1], config, body=body, verbose=False)
    assert done.history.steps_done == config.steps
    assert done.history.validation == []
    assert len(done.frames) == 1
    assert all(np.isfinite(values).all() for values in done.history.terms.values())


def test_memory_knows_the_frames_chosen_and_not_how_many_there_are(case):
    """Of 3000 frames those chosen are read, one at a time, and none is held."""
    body, frames, config, _, _ = case
    config = replace(config, validation=replace(config.validation, frames=2))
    template, faces = frames[0].vertices, frames[0].faces
    held_now, read, most = set(), [], [0]

    class Vertices(np.ndarray):
        """An array that can be watched."""

    def load(i):
        gc.collect()
        most[0] = max(most[0], len(held_now))
        vertices = np.array(template).view(Vertices)
        number = len(read)
        held_now.add((i, number))
        weakref.finalize(vertices, held_now.discard, (i, number))
        read.append(i)
        return vertices, faces

    def pool_of(count):
        read.clear()
        params = frames.params[np.zeros(count, int)]
        lazy = xa.Frames(params, load, part_labels=np.asarray(body.part_labels), body=body)
        learned, held = choose_frames(lazy, config)
        pool = labelled(body, lazy[np.concatenate([learned, held])])
        assert sorted(read) == sorted([*learned, *held])
        return sum(leaf.nbytes for leaf in jax.tree.leaves(pool))

    assert pool_of(3000) == pool_of(300)
    assert len(read) == config.train_frames + config.validation.frames
    assert most[0] <= 1


def test_a_frame_far_from_its_parameters_is_named_and_teaches_nothing(case, no_prefit):
    body, frames, config, _, _ = case
    config = replace(config, steps=2, report_every=1)

    def shifted(metres):
        moved = with_meshes(frames, lambda k, v, f: (v + np.array([metres * (k == 1), 0, 0]), f))
        with pytest.warns(TrainingNotice) as said:
            done = xa.fit(moved, config, body=body, verbose=False)
        words = "1 of 3 frames have no point that was found on the body"
        assert any(words in str(w.message) and "scan_1" in str(w.message) for w in said)
        return done.history.terms

    near, far = shifted(5.0), shifted(50.0)
    assert near["occupancy"] == far["occupancy"]


def test_frames_that_are_all_far_from_their_parameters_are_refused(case, no_prefit):
    body, frames, config, _, _ = case
    moved = with_meshes(frames, lambda k, v, f: (v + 5.0, f))
    with (
        pytest.warns(TrainingNotice, match="do not fit"),
        pytest.raises(ValueError, match=r"no point of any frame.*scan_0, scan_1, scan_2.*units"),
    ):
        xa.fit(moved, config, body=body, verbose=False)


def test_expression_that_no_field_reads_is_said(case):
    params = case[1].params
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_expression(params, None)
        check_expression(replace(params, expression=np.zeros((3, 50))), None)
    more = np.zeros((3, 50))
    more[1, 12] = -2.5
    with pytest.warns(TrainingNotice, match=r"50 coefficients.*first 10.*reach 2\.5"):
        check_expression(replace(params, expression=more), None)


def test_points_beyond_the_grids_are_counted(case):
    frames = case[1]
    check_found(frames, np.array([100, 95, 90]), 100, None)
    kept = []
    with pytest.warns(TrainingNotice, match="30% of the points were not found"):
        check_found(frames, np.array([70, 70, 70]), 100, kept)
    assert len(kept) == 1


def test_one_person_has_one_shape(case, no_prefit, monkeypatch):
    """Frames fitted one by one, each with betas of its own: their mean is everybody's."""
    body, frames, config, _, _ = case
    betas = np.random.default_rng(0).normal(size=(3, 10)).astype(np.float32)
    params = replace(frames.params, betas=betas)
    seen = []

    def stop(_, frames, *rest, **options):
        seen.append(frames)
        raise KeyError("seen enough")

    monkeypatch.setattr(loop, "label_frames", stop)
    with (
        pytest.warns(TrainingNotice, match=r"betas differ from frame to frame, by up to \d"),
        pytest.raises(KeyError, match="seen enough"),
    ):
        xa.fit(frames.with_params(params), config, body=body, verbose=False)
    np.testing.assert_allclose(seen[0].params.betas, np.tile(betas.mean(0), (3, 1)), rtol=1e-6)


@pytest.mark.parametrize("minutes", [0, -1.0, float("nan")])
def test_budgets_are_positive(case, minutes):
    body, frames, config, _, _ = case
    with pytest.raises(ValueError, match="minutes must be a positive number"):
        xa.fit(frames, replace(config, minutes=minutes), body=body)
