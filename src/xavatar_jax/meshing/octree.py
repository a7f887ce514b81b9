"""An octree refined where a field changes sign, sampled at the centres of its leaves."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np
from jaxtyping import Bool, Float, Int

from .sampler import FieldSampler

_OCTANTS = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)], dtype=np.int32)
_NUMBERS = np.arange(8, dtype=np.int32)
_AXES = np.repeat(np.arange(3), 2)
_SIDES = np.tile([1, 0], 3)

# Nodes, a face of each, and the nodes across it: arrays of equal length.
Meeting = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass
class Octree:
    """A forest of octrees on a regular grid of roots.

    Lattice coordinates count finest cells from `origin`. A node of level l has an edge of 2**l
    finest cells; nodes without children are the leaves, and they tile the box.

    Attributes:
        origin: lowest corner of the root grid (3,), metres.
        cell: edge of the finest cell, metres.
        depth: level of the roots.
        shape: number of roots along each axis.
        corner: lowest lattice corner of each node (N, 3).
        level: level of each node (N,).
        first_child: index of the first of eight consecutive children (N,), -1 for a leaf.
        value: the field at the node's centre (N,), positive inside.
        corner_signs: signs of the field where it is known at two opposite corners (N, 2), 0 where
            it is not: at the parent's centre, and opposite it.
    """

    origin: Float[np.ndarray, "3"]
    cell: float
    depth: int
    shape: Int[np.ndarray, "3"]
    corner: Int[np.ndarray, "N 3"]
    level: Int[np.ndarray, "N"]
    first_child: Int[np.ndarray, "N"]
    value: Float[np.ndarray, "N"]
    corner_signs: Int[np.ndarray, "N 2"]

    def centres(self, nodes: Int[np.ndarray, "M"] | slice) -> Float[np.ndarray, "M 3"]:
        """Centres of nodes, metres."""
        centres = self.corner[nodes].astype(np.float64)
        centres += 0.5 * (1 << self.level[nodes].astype(np.int32))[:, None]
        centres *= self.cell
        centres += self.origin
        return centres

    def sizes(self, nodes: Int[np.ndarray, "M"]) -> Float[np.ndarray, "M"]:
        """Edges of nodes, metres."""
        return self.cell * (1 << self.level[nodes].astype(np.int64))

    def locate(
        self, lattice: Int[np.ndarray, "M 3"], least: Int[np.ndarray, "M"] | int = 0
    ) -> Int[np.ndarray, "M"]:
        """The leaf that holds each finest lattice cell; cells outside clamp to the border.

        Where the level of the leaf is below `least`, the ancestor at that level is returned.
        """
        lattice = np.clip(lattice, 0, ((self.shape << self.depth) - 1).astype(lattice.dtype))
        root = lattice >> self.depth
        node = (root[:, 0] * self.shape[1] + root[:, 1]) * self.shape[2] + root[:, 2]
        node = node.astype(np.int32)
        for level in range(self.depth - 1, -1, -1):
            child = self.first_child[node]
            bits = lattice >> level & 1
            octant = bits[:, 0] << 2 | bits[:, 1] << 1 | bits[:, 2]
            node = np.where((child >= 0) & (level >= least), child + octant, node)
        return node

    def split(self, nodes: Int[np.ndarray, "M"], sampler: FieldSampler) -> Int[np.ndarray, "M8"]:
        """Give each leaf in `nodes` eight children, evaluate them, and return their indices."""
        start = len(self.level)
        self.first_child[nodes] = start + 8 * np.arange(len(nodes), dtype=np.int32)
        level = np.repeat(self.level[nodes] - 1, 8).astype(self.level.dtype)
        offset = np.tile(_OCTANTS, (len(nodes), 1)) << level[:, None].astype(np.int32)
        self.corner = np.concatenate([self.corner, np.repeat(self.corner[nodes], 8, 0) + offset])
        self.level = np.concatenate([self.level, level])
        children = np.arange(start, len(self.level), dtype=np.int32)
        self.first_child = np.concatenate([self.first_child, np.full_like(children, -1)])
        self.value = np.concatenate([self.value, sampler(self.centres(slice(start, None)))])
        self.corner_signs = np.concatenate([self.corner_signs, self._children_signs(nodes)])
        return children

    def crossed(self, nodes: Int[np.ndarray, "M"]) -> Bool[np.ndarray, "M"]:
        """Whether the field differs in sign between a known corner and the centre."""
        return np.any(self.corner_signs[nodes] * _signs(self.value[nodes])[:, None] < 0, axis=1)

    def _children_signs(self, nodes: Int[np.ndarray, "M"]) -> Int[np.ndarray, "M8 2"]:
        """Known corner signs of the children of `nodes`.

        Each child touches its parent's centre. The children at the parent's known corners inherit
        those too: what a coarse sample has seen is kept even if finer samples miss it.
        """
        signs = np.zeros((len(nodes), 8, 2), dtype=np.int8)
        signs[:, :, 0] = _signs(self.value[nodes])[:, None]
        bits = self.corner[nodes] >> self.level[nodes].astype(np.int32)[:, None] & 1
        octant = bits[:, 0] << 2 | bits[:, 1] << 1 | bits[:, 2]
        row = np.arange(len(nodes))
        signs[row, 7 - octant, 1] = self.corner_signs[nodes, 0]
        signs[row, octant, 1] = self.corner_signs[nodes, 1]
        return signs.reshape(-1, 2)


def root_octree(sampler: FieldSampler, cell: float, depth: int) -> Octree:
    """A grid of roots of `cell * 2**depth` over the sampler's bounds and one root beyond."""
    root = cell * (1 << depth)
    extent = sampler.bounds[1] - sampler.bounds[0]
    shape = np.ceil(extent / root * (1 - 1e-9)).astype(np.int64) + 2
    origin = sampler.bounds.mean(axis=0) - 0.5 * root * shape
    index = np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), axis=-1)
    corner = (index.reshape(-1, 3) << depth).astype(np.int32)
    count = len(corner)
    return Octree(
        origin,
        cell,
        depth,
        shape,
        corner=corner,
        level=np.full(count, depth, dtype=np.int8),
        first_child=np.full(count, -1, dtype=np.int32),
        value=sampler(origin + cell * (corner + 0.5 * (1 << depth))),
        corner_signs=np.zeros((count, 2), dtype=np.int8),
    )


def refine(
    tree: Octree,
    sampler: FieldSampler,
    target_level: Callable[[Float[np.ndarray, "M 3"]], Int[np.ndarray, "M"]],
    seeds: Float[np.ndarray, "S 3"] | None,
    max_leaves: int,
) -> Int[np.ndarray, "K 2"]:
    """Split leaves until all leaves at the surface have the wanted size.

    A leaf coarser than wanted is split if a face neighbour or one of its known corners has the
    other sign; any leaf is split if such a neighbour is less than half its size. New leaves are
    compared with their neighbours again, so the surface is followed into parts that the roots
    missed. The leaf of a seed and the leaves next to it are split down to twice the size wanted
    there, whatever the signs.

    Returns the face-adjacent leaf pairs of opposite sign, finer leaf first: (K, 2).
    """
    hanging_leaf = hanging_face = hanging_other = np.zeros(0, dtype=np.int64)
    pairs = np.zeros((0, 2), dtype=np.int64)
    wanted = np.full(len(tree.level), -1, dtype=np.int8)
    seed_cell = seed_level = None
    if seeds is not None and len(seeds):
        seed_level = np.minimum(target_level(seeds) + 1, tree.depth)
        seed_cell, seed_level = _seed_cells(tree, seeds, seed_level)
    new = np.arange(len(tree.level))
    meetings = _meetings_of_roots(tree)
    while True:
        split, inside = tree.first_child >= 0, tree.value > 0
        keep = ~split[hanging_leaf]
        stale = keep & split[hanging_other]
        keep &= ~stale
        again = hanging_leaf[stale], hanging_face[stale]
        hanging = [(hanging_leaf[keep], hanging_face[keep], hanging_other[keep])]
        crossings = [pairs[~(split[pairs[:, 0]] | split[pairs[:, 1]])]]
        for leaf, face, other in chain(meetings, [(*again, _across(tree, *again))]):
            own, level = tree.level[leaf], tree.level[other]
            coarser = np.flatnonzero(level > own)
            hanging.append((leaf[coarser], face[coarser], other[coarser]))
            crossed = np.flatnonzero(inside[leaf] != inside[other])
            leaf, other, own, level = leaf[crossed], other[crossed], own[crossed], level[crossed]
            # From the finer side, or once if both have one size.
            once = (level > own) | ((level == own) & (leaf < other) & ~split[other])
            crossings.append(np.stack([leaf[once], other[once]], axis=1))
        hanging_leaf, hanging_face, hanging_other = (
            np.concatenate(parts) for parts in zip(*hanging, strict=True)
        )
        pairs = np.concatenate(crossings)

        touched = np.zeros(len(tree.level), dtype=bool)
        touched[pairs] = True
        touched[new[tree.crossed(new)]] = True
        touched = np.flatnonzero(touched)
        unknown = touched[wanted[touched] < 0]
        wanted[unknown] = target_level(tree.centres(unknown))
        flagged = np.zeros(len(tree.level), dtype=bool)
        flagged[touched[tree.level[touched] > wanted[touched]]] = True
        flagged[pairs[tree.level[pairs[:, 1]] > tree.level[pairs[:, 0]] + 1, 1]] = True
        if seed_cell is not None:
            at_seed = tree.locate(seed_cell)
            flagged[at_seed[tree.level[at_seed] > seed_level]] = True
        flagged = np.flatnonzero(flagged)
        if len(flagged) == 0:
            return pairs
        if len(tree.level) + 8 * len(flagged) > max_leaves:
            raise ValueError(
                f"meshing at cells of {tree.cell:g} m needs more than {max_leaves} octree nodes: "
                "use a larger cell, or check whether the field is noise."
            )
        new = tree.split(flagged, sampler)
        wanted = np.concatenate([wanted, np.full(len(new), -1, dtype=np.int8)])
        meetings = _meetings_of_children(tree, flagged)


def _meetings_of_roots(tree: Octree) -> Iterator[Meeting]:
    """Roots, a face of each, and the roots across it."""
    roots = np.arange(len(tree.level))
    for face in range(6):
        faces = np.full(len(roots), face, dtype=np.int8)
        yield roots, faces, _across(tree, roots, faces)


def _meetings_of_children(tree: Octree, parents: Int[np.ndarray, "M"]) -> Iterator[Meeting]:
    """Children of nodes just split, a face of each, and what is across: no finer, or split itself.

    Siblings meet once. One look-up across a parent's face serves its four children there.
    """
    first = tree.first_child[parents]
    level = tree.level[parents]
    for face in range(6):
        bit = np.int32(4 >> _AXES[face])
        octants = _NUMBERS[(_NUMBERS & bit > 0) == (_SIDES[face] == 1)]
        leaf = (first[:, None] + octants).reshape(-1)
        faces = np.full(len(leaf), face, dtype=np.int8)
        if _SIDES[face] == 0:  # from the lower side to the upper
            yield leaf, faces - 1, leaf + bit
        beyond = _across(tree, parents, faces[: len(parents)], level)
        child = tree.first_child[beyond][:, None]
        other = np.where(child >= 0, child + (octants ^ bit), beyond[:, None])
        other = np.where((beyond == parents)[:, None], leaf.reshape(other.shape), other)
        yield leaf, faces, other.reshape(-1)


def _seed_cells(
    tree: Octree, seeds: Float[np.ndarray, "S 3"], level: Int[np.ndarray, "S"]
) -> tuple[Int[np.ndarray, "C 3"], Int[np.ndarray, "C"]]:
    """Lattice cells at each seed and at its six neighbours, and the levels wanted there."""
    coarse = np.floor((seeds - tree.origin) / tree.cell).astype(np.int64) >> level[:, None]
    steps = np.concatenate([np.zeros((1, 3), np.int64), np.eye(3, dtype=np.int64)])
    steps = np.concatenate([steps, -steps[1:]])
    rows = np.concatenate([coarse, level[:, None]], axis=1)
    around = np.unique(rows, axis=0)[:, None].repeat(len(steps), axis=1)
    around[..., :3] += steps
    around = np.unique(around.reshape(-1, 4), axis=0)
    return around[:, :3] << around[:, 3:], around[:, 3]


def _signs(value: Float[np.ndarray, "M"]) -> Int[np.ndarray, "M"]:
    """1 inside, -1 outside."""
    return np.where(value > 0, 1, -1).astype(np.int8)


def _across(
    tree: Octree,
    leaf: Int[np.ndarray, "M"],
    face: Int[np.ndarray, "M"],
    least: Int[np.ndarray, "M"] | int = 0,
) -> Int[np.ndarray, "M"]:
    """A leaf on the other side of a leaf's face, no finer than level `least`.

    At the border this is the leaf itself.
    """
    probe = tree.corner[leaf]
    size = 1 << tree.level[leaf].astype(np.int32)
    axis, side = _AXES[face], _SIDES[face]
    probe[np.arange(len(leaf)), axis] += np.where(side == 1, size, -1)
    return tree.locate(probe, least)
