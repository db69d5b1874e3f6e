"""Small connected groups of joints, which a solver takes whole, and the bones between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

Bones = tuple[tuple[int, int], ...]
"""Index pairs of joints."""


@dataclass(frozen=True)
class BodyGroups:
    """A partition of J joints for a solver that alternates between two halves of the body.

    No bone joins two groups of the same half, so that given the joints of one half the groups of
    the other are independent of each other.
    """

    even: tuple[tuple[int, ...], ...]
    odd: tuple[tuple[int, ...], ...]
    inner: tuple[int, ...]
    """The bones within a group, by their index."""
    outer: tuple[int, ...]
    """The bones between an even and an odd group."""


@lru_cache(maxsize=32)
def spanning_bones(joints: int, bones: Bones) -> tuple[int, ...]:
    """Return the indices of bones that make no circle: a spanning forest of the joints."""
    tree = list(range(joints))

    def root(joint: int) -> int:
        while tree[joint] != joint:
            joint = tree[joint]
        return joint

    kept = []
    for index, (start, end) in enumerate(bones):
        one = root(start)
        other = root(end)
        if one != other:
            tree[other] = one
            kept.append(index)
    return tuple(kept)


@lru_cache(maxsize=32)
def body_groups(joints: int, bones: Bones, largest: int) -> BodyGroups:
    """Return groups of at most ``largest`` joints of a skeleton whose bones make no circle."""
    neighbours = _neighbours(joints, bones)
    groups: list[tuple[int, ...]] = []
    for tree in _trees(neighbours):
        groups += _cut(tree, largest)
    group_of = {joint: number for number, group in enumerate(groups) for joint in group}
    links = [(group_of[start], group_of[end]) for start, end in bones]
    inner = [index for index, (one, other) in enumerate(links) if one == other]
    outer = [index for index, (one, other) in enumerate(links) if one != other]
    linked = _neighbours(len(groups), [links[index] for index in outer])
    halves: tuple[list[tuple[int, ...]], list[tuple[int, ...]]] = ([], [])
    for tree in _trees(linked):
        for number, _, depth in tree:
            halves[depth % 2].append(groups[number])
    even, odd = halves
    return BodyGroups(tuple(even), tuple(odd), tuple(inner), tuple(outer))


_Visit = tuple[int, int | None, int]
"""A node, its parent and its depth in a tree."""


def _neighbours(nodes: int, edges: Sequence[tuple[int, int]]) -> list[list[int]]:
    neighbours: list[list[int]] = [[] for _ in range(nodes)]
    for start, end in edges:
        neighbours[start].append(end)
        neighbours[end].append(start)
    return neighbours


def _trees(neighbours: Sequence[Sequence[int]]) -> list[list[_Visit]]:
    """Return the trees of a forest, each from its root outwards."""
    found: set[int] = set()
    trees = []
    for root in range(len(neighbours)):
        if root in found:
            continue
        found.add(root)
        tree: list[_Visit] = [(root, None, 0)]
        for node, parent, depth in tree:  # grows while it is walked through
            children = [other for other in neighbours[node] if other != parent]
            found.update(children)
            tree += [(child, node, depth + 1) for child in children]
        trees.append(tree)
    return trees


def _cut(tree: Sequence[_Visit], largest: int) -> list[tuple[int, ...]]:
    """Cut a tree into connected groups, from its leaves inwards; small branches stay together."""
    branches: dict[int, list[list[int]]] = {node: [] for node, _, _ in tree}
    groups = []
    for node, parent, _ in reversed(tree):
        group = [node]
        for branch in sorted(branches[node], key=len):
            if len(group) + len(branch) <= largest:
                group += branch
            else:
                groups.append(branch)
        if parent is None:
            groups.append(group)
        else:
            branches[parent].append(group)
    return [tuple(sorted(group)) for group in groups]
