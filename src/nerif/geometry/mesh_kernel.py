"""Rays and points against triangles, compiled by Numba in double precision.

The triangles stand in the order of a Morton curve under a complete binary tree of boxes: node i has the children
2 i + 1 and 2 i + 2, and each leaf has a run of triangles. Kernels have one thread, the caller's.

Sources: ray and triangle, Moeller & Trumbore, J. Graphics Tools 2 (1997) 21; closest point of a triangle, Ericson,
Real-Time Collision Detection (2005), section 5.1.5.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numba import njit

__all__ = ["Tree", "closest", "first_hits", "tree_of", "windings"]

LEAF = 4  # triangles, about
BITS = 16  # of the Morton code along each axis
SLACK = 1e-9  # of the size of the mesh, by which boxes are larger, and of a triangle, by which rays hit its edges
DEPTH = 64  # of the stack: the tree of 2^63 leaves
OBLIQUE = np.array([0.5377667, 0.3188765, 0.7804541])  # direction in which no edge of a drawn model lies


class Tree(NamedTuple):
    """Triangles under a tree of boxes."""

    boxes: Float[np.ndarray, "node 6"]  # lower and upper corner, mm
    begin: Int[np.ndarray, " leaf+1"]  # first triangle of each leaf
    corners: Float[np.ndarray, "triangle 3 3"]
    order: Int[np.ndarray, " triangle"]  # index of each triangle in the mesh


def tree_of(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> Tree:
    """Return the tree of a mesh."""
    corners = vertices[faces]
    lower, upper = vertices.min(axis=0), vertices.max(axis=0)
    size = float((upper - lower).max())
    places = ((corners.mean(axis=1) - lower) / size * ((1 << BITS) - 1)).astype(np.uint64)
    order = np.argsort(_morton(places), kind="stable")
    corners = np.ascontiguousarray(corners[order])
    leaves = 1 << max(0, (len(faces) // LEAF).bit_length() - 1)
    begin = np.arange(leaves + 1) * len(faces) // leaves
    boxes = np.empty((2 * leaves - 1, 6))
    boxes[leaves - 1 :, :3] = np.minimum.reduceat(corners.min(axis=1), begin[:-1]) - SLACK * size
    boxes[leaves - 1 :, 3:] = np.maximum.reduceat(corners.max(axis=1), begin[:-1]) + SLACK * size
    while leaves > 1:
        children, leaves = boxes[leaves - 1 : 2 * leaves - 1].reshape(-1, 2, 6), leaves // 2
        boxes[leaves - 1 : 2 * leaves - 1, :3] = children[:, :, :3].min(axis=1)
        boxes[leaves - 1 : 2 * leaves - 1, 3:] = children[:, :, 3:].max(axis=1)
    return Tree(boxes, begin, corners, order)


def _morton(places: Int[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """Interleave the bits of x, y and z."""
    code = np.zeros(len(places), np.uint64)
    for bit in range(BITS):
        for axis in range(3):
            code |= ((places[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return code


@njit(nogil=True)
def _into(boxes, node, origin, inverse, begin, end):
    """Path length at which a ray enters a box between begin and end; infinity if it misses it."""
    for a in range(3):
        p, q = (boxes[node, a] - origin[a]) * inverse[a], (boxes[node, a + 3] - origin[a]) * inverse[a]
        begin, end = max(begin, min(p, q)), min(end, max(p, q))
    return begin if begin <= end else np.inf


@njit(nogil=True)
def _meets(corner, origin, direction, slack):
    """Path length at which a line meets a triangle (infinity: not), and its determinant, above 0 on the way in."""
    e0, e1, e2 = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1], corner[1, 2] - corner[0, 2]
    f0, f1, f2 = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2]
    d0, d1, d2 = direction[0], direction[1], direction[2]
    p0, p1, p2 = d1 * f2 - d2 * f1, d2 * f0 - d0 * f2, d0 * f1 - d1 * f0
    determinant = e0 * p0 + e1 * p1 + e2 * p2
    if determinant == 0.0:
        return np.inf, determinant
    t0, t1, t2 = origin[0] - corner[0, 0], origin[1] - corner[0, 1], origin[2] - corner[0, 2]
    u = (t0 * p0 + t1 * p1 + t2 * p2) / determinant
    q0, q1, q2 = t1 * e2 - t2 * e1, t2 * e0 - t0 * e2, t0 * e1 - t1 * e0
    v = (d0 * q0 + d1 * q1 + d2 * q2) / determinant
    if u < -slack or v < -slack or u + v > 1.0 + slack:
        return np.inf, determinant
    return (f0 * q0 + f1 * q1 + f2 * q2) / determinant, determinant


@njit(nogil=True)
def _inverse(direction):
    inverse = np.empty(3)
    for a in range(3):
        inverse[a] = 1.0 / direction[a] if abs(direction[a]) > 1e-300 else 1e300
    return inverse


@njit(nogil=True, cache=True)
def first_hits(tree, origin, direction, begin, end):
    """Return the path lengths at which rays first meet a triangle between begin and end; infinity without one."""
    boxes, begins, corners = tree.boxes, tree.begin, tree.corners
    result, stack, inner = np.full(len(origin), np.inf), np.empty(DEPTH, np.int64), len(begins) - 2
    for i in range(len(origin)):
        inverse, nearest = _inverse(direction[i]), end[i]
        stack[0], count = 0, 1
        while count:
            count -= 1
            node = stack[count]
            if _into(boxes, node, origin[i], inverse, begin[i], nearest) == np.inf:
                continue
            if node < inner:
                stack[count], stack[count + 1] = 2 * node + 1, 2 * node + 2
                count += 2
                continue
            for k in range(begins[node - inner], begins[node - inner + 1]):
                s, _ = _meets(corners[k], origin[i], direction[i], SLACK)
                if begin[i] <= s <= nearest:
                    nearest = result[i] = s
    return result


@njit(nogil=True, cache=True)
def windings(tree, points):
    """Return how often the mesh encloses points: ways out less ways in along a half-line."""
    boxes, begins, corners = tree.boxes, tree.begin, tree.corners
    result, stack, inner = np.zeros(len(points), np.int64), np.empty(DEPTH, np.int64), len(begins) - 2
    inverse = _inverse(OBLIQUE)
    for i in range(len(points)):
        stack[0], count = 0, 1
        while count:
            count -= 1
            node = stack[count]
            if _into(boxes, node, points[i], inverse, 0.0, np.inf) == np.inf:
                continue
            if node < inner:
                stack[count], stack[count + 1] = 2 * node + 1, 2 * node + 2
                count += 2
                continue
            for k in range(begins[node - inner], begins[node - inner + 1]):
                s, determinant = _meets(corners[k], points[i], OBLIQUE, 0.0)
                if 0.0 <= s < np.inf:
                    result[i] += 1 if determinant < 0.0 else -1
    return result


@njit(nogil=True)
def _to_box(boxes, node, point):
    """Squared distance of a point from a box."""
    squared = 0.0
    for a in range(3):
        outside = max(boxes[node, a] - point[a], point[a] - boxes[node, a + 3], 0.0)
        squared += outside * outside
    return squared


@njit(nogil=True)
def _weights(corner, point):
    """Weights of the corners b and c, beside a, at the point of a triangle that is closest to a point."""
    d1 = d2 = d3 = d4 = d5 = d6 = 0.0
    for i in range(3):
        ab, ac = corner[1, i] - corner[0, i], corner[2, i] - corner[0, i]
        d1 += ab * (point[i] - corner[0, i])
        d2 += ac * (point[i] - corner[0, i])
        d3 += ab * (point[i] - corner[1, i])
        d4 += ac * (point[i] - corner[1, i])
        d5 += ab * (point[i] - corner[2, i])
        d6 += ac * (point[i] - corner[2, i])
    if d1 <= 0.0 and d2 <= 0.0:
        return 0.0, 0.0
    if d3 >= 0.0 and d4 <= d3:
        return 1.0, 0.0
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 1.0
    vc, vb, va = d1 * d4 - d3 * d2, d5 * d2 - d1 * d6, d3 * d6 - d5 * d4
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return d1 / (d1 - d3), 0.0
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return 0.0, d2 / (d2 - d6)
    if va <= 0.0 and d4 >= d3 and d5 >= d6:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 1.0 - w, w
    return vb / (va + vb + vc), vc / (va + vb + vc)


@njit(nogil=True, cache=True)
def closest(tree, points, reach):
    """Return the points of the mesh that are closest to points, if they are within reach (NaN: they are not).

    With them go their barycentric coordinates and their triangles.
    """
    boxes, begins, corners = tree.boxes, tree.begin, tree.corners
    where, face, on = np.full((len(points), 3), np.nan), np.full(len(points), tree.order[0]), np.empty(3)
    weights = np.full((len(points), 3), np.nan)
    stack, inner = np.empty(DEPTH, np.int64), len(begins) - 2
    for i in range(len(points)):
        best = reach * reach
        stack[0], count = 0, 1
        while count:
            count -= 1
            node = stack[count]
            if _to_box(boxes, node, points[i]) >= best:
                continue
            if node < inner:
                left, right = 2 * node + 1, 2 * node + 2
                if _to_box(boxes, left, points[i]) < _to_box(boxes, right, points[i]):
                    left, right = right, left
                stack[count], stack[count + 1] = left, right  # the nearer one first
                count += 2
                continue
            for k in range(begins[node - inner], begins[node - inner + 1]):
                v, w = _weights(corners[k], points[i])
                squared = 0.0
                for a in range(3):
                    on[a] = (1.0 - v - w) * corners[k, 0, a] + v * corners[k, 1, a] + w * corners[k, 2, a]
                    squared += (on[a] - points[i, a]) ** 2
                if squared < best:
                    best, face[i] = squared, tree.order[k]
                    where[i] = on
                    weights[i, 0], weights[i, 1], weights[i, 2] = 1.0 - v - w, v, w
    return where, weights, face
