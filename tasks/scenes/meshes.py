"""Small closed triangle meshes, and their union as one asset: drawing one mesh is cheaper than many primitives.

A mesh is a pair of vertices (V, 3) in metres and faces (F, 3), counter-clockwise seen from outside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imagine_bench.arrays import Floats

from .constants import Point

_CAP_RAD = np.pi / 4
"""Latitude of the ring that rounds a limb's tip."""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh."""

    vertices: Floats  #: shape (V, 3), metres
    faces: NDArray[np.int64]  #: vertex indices. Shape (F, 3).


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """The union of several meshes, overlapping or not, as one."""
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=True)]),
    )


def _rings_to_mesh(rings: Floats, first: Floats, last: Floats) -> Mesh:
    """Stitch rings (R, N, 3), counter-clockwise about the way from ``first`` to ``last``, into a closed surface."""
    n_rings, n_sides = rings.shape[:2]
    vertices = np.concatenate([rings.reshape(-1, 3), first[None], last[None]])
    side = np.arange(n_sides)
    following = (side + 1) % n_sides
    low = n_sides * np.arange(n_rings - 1)[:, None]
    high = low + n_sides
    top = n_sides * (n_rings - 1)
    between = [[low + side, low + following, high + following], [low + side, high + following, high + side]]
    bottom = [np.full(n_sides, len(vertices) - 2), following, side]
    lid = [top + side, top + following, np.full(n_sides, len(vertices) - 1)]
    rows = np.moveaxis(np.array(between), (0, 1, 2, 3), (1, 3, 0, 2)).reshape(
        -1, 3
    )  # ring by ring, two triangles a side
    return Mesh(vertices, np.concatenate([np.transpose(bottom), rows, np.transpose(lid)]))


def _frames_along(axes: Floats) -> Floats:
    """Two unit vectors that complete each axis (R, 3) to a right-handed frame, all turned alike. Shape (R, 2, 3)."""
    helper = np.eye(3)[int(np.abs(axes).max(axis=0).argmin())]
    u = np.cross(axes, helper)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return np.stack([u, np.cross(axes, u)], axis=1)


def limb(joints: ArrayLike, *, sides: int) -> Mesh:
    """A bent, tapered tube through joints, rounded at its last one, such as a finger.

    Args:
        joints: At least two of (x, y, z, radius), metres, from the root to the tip.
        sides: Corners of a cross-section, at least 3.
    """
    points, radii = np.split(np.asarray(joints, dtype=np.float64), [3], axis=1)
    bones = np.diff(points, axis=0)
    bones /= np.linalg.norm(bones, axis=1, keepdims=True)
    tip = bones[-1]
    # A ring at every joint, square to the mean of its two bones, and one more that rounds the tip.
    normals = np.concatenate([bones[:1], bones[:-1] + bones[1:], bones[-1:], bones[-1:]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    centers = np.concatenate([points, points[-1:] + np.sin(_CAP_RAD) * radii[-1] * tip])
    scales = np.concatenate([radii, np.cos(_CAP_RAD) * radii[-1:]])
    across = _frames_along(normals)  # [R, 2, 3]
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ across  # [R, N, 3]
    rings = centers[:, None] + scales[:, None] * circle
    return _rings_to_mesh(rings, points[0] - 0.5 * radii[0] * bones[0], points[-1] + radii[-1] * tip)


def rounded(joints: ArrayLike, *, times: int = 3) -> Floats:
    """A path of joints whose corners are cut ``times`` times (Chaikin, 1974); its ends stay. Shape (N, 4)."""
    path = np.asarray(joints, dtype=np.float64)
    for _ in range(times):
        near = 0.75 * path[:-1] + 0.25 * path[1:]
        far = 0.25 * path[:-1] + 0.75 * path[1:]
        inner = np.stack([near, far], axis=1).reshape(-1, path.shape[1])
        path = np.concatenate([path[:1], inner, path[-1:]])
    return path


def ellipsoid(center: Point, radii: Point, *, sides: int, rings: int) -> Mesh:
    """An ellipsoid with its axes along x, y and z.

    Args:
        center: Metres.
        radii: Metres.
        sides: Corners of a cross-section.
        rings: Cross-sections between the poles.
    """
    latitude = np.linspace(-np.pi / 2, np.pi / 2, rings + 2)[1:-1, None]
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)[None, :]
    unit = np.stack([np.cos(latitude) * np.cos(angle), np.cos(latitude) * np.sin(angle), np.sin(latitude + 0 * angle)])
    pole = np.array([0.0, 0.0, radii[2]])
    return _rings_to_mesh(np.array(center) + np.moveaxis(unit, 0, -1) * radii, center - pole, center + pole)


def stack(outlines: Sequence[ArrayLike], heights_m: Sequence[float], middle: ArrayLike = (0.0, 0.0)) -> Mesh:
    """A solid between level outlines, each star-shaped about one middle, closed by its lowest and its highest.

    Args:
        outlines: Corners in the x-y plane, counter-clockwise seen from above, metres. Shapes (N, 2).
        heights_m: Of each outline, ascending.
        middle: In the x-y plane, metres. Shape (2,).
    """
    rings = [np.insert(np.asarray(each), 2, z, axis=1) for each, z in zip(outlines, heights_m, strict=True)]
    return _rings_to_mesh(np.array(rings), np.append(middle, heights_m[0]), np.append(middle, heights_m[-1]))


def box(low: Point, high: Point, *, taper: float = 1.0) -> Mesh:
    """A box between two corners, in metres, its top shrunk about its middle by ``taper``, in (0, 1]."""
    middle = (np.array(low[:2]) + high[:2]) / 2
    half = (np.array(high[:2]) - low[:2]) / 2
    corners = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    outlines = [middle + scale * half * corners for scale in (1.0, taper)]
    return stack(outlines, (low[2], high[2]), middle)


def turned_profile(profile: Sequence[tuple[float, float]], *, sides: int) -> Mesh:
    """A solid of revolution about z, such as a cup: (radius, z) from the bottom to the top, metres."""
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return stack([radius * circle for radius, _ in profile], [z for _, z in profile])


def arch(center: Point, *, radius: float, thickness: float) -> Mesh:
    """Half a ring in the x-z plane that bulges toward -x, such as a cup's handle.

    Args:
        center: Middle of the ring's chord, metres.
        radius: Of the ring's centre line.
        thickness: Radius of the bent rod.
    """
    x, y, z = center
    angle = np.linspace(-np.pi / 2, np.pi / 2, 7)
    return limb([(x - radius * np.cos(a), y, z + radius * np.sin(a), thickness) for a in angle], sides=5)
