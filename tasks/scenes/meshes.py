"""Small closed triangle meshes, and their union as one asset: drawing one mesh is cheaper than many primitives.

A mesh is a pair of vertices (V, 3) in metres and faces (F, 3), counter-clockwise seen from outside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

_CAP_RAD = np.pi / 4
"""Latitude of the ring that rounds a limb's tip."""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh."""

    vertices: NDArray[np.float64]  #: shape (V, 3), metres
    faces: NDArray[np.int64]  #: vertex indices. Shape (F, 3).


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """The union of several meshes, overlapping or not, as one."""
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=True)]),
    )


def _rings_to_mesh(rings: NDArray[np.float64], first: NDArray[np.float64], last: NDArray[np.float64]) -> Mesh:
    """Stitch rings (R, N, 3), counter-clockwise about the way from ``first`` to ``last``, into a closed surface."""
    n_rings, n_sides = rings.shape[:2]
    vertices = np.concatenate([rings.reshape(-1, 3), first[None], last[None]])
    side = np.arange(n_sides)
    following = (side + 1) % n_sides
    faces = [np.stack([np.full(n_sides, len(vertices) - 2), following, side], axis=1)]
    for ring in range(n_rings - 1):
        low = ring * n_sides
        high = (ring + 1) * n_sides
        faces.append(np.stack([low + side, low + following, high + following], axis=1))
        faces.append(np.stack([low + side, high + following, high + side], axis=1))
    top = (n_rings - 1) * n_sides
    faces.append(np.stack([top + side, top + following, np.full(n_sides, len(vertices) - 1)], axis=1))
    return Mesh(vertices, np.concatenate(faces).astype(np.int64))


def _frames_along(axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Two unit vectors that complete each axis (R, 3) to a right-handed frame, all turned alike. Shape (R, 2, 3)."""
    helper = np.eye(3)[int(np.abs(axes).max(axis=0).argmin())]
    u = np.cross(axes, helper)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return np.stack([u, np.cross(axes, u)], axis=1)


def limb(joints: Sequence[tuple[float, float, float, float]], *, sides: int = 8) -> Mesh:
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


def ellipsoid(center: ArrayLike, radii: ArrayLike, *, sides: int = 10, rings: int = 5) -> Mesh:
    """An ellipsoid with its axes along x, y and z.

    Args:
        center: Metres. Shape (3,).
        radii: Metres. Shape (3,).
        sides: Corners of a cross-section.
        rings: Cross-sections between the poles.
    """
    center = np.asarray(center, dtype=np.float64)
    radii = np.asarray(radii, dtype=np.float64)
    latitude = np.linspace(-np.pi / 2, np.pi / 2, rings + 2)[1:-1, None]
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)[None, :]
    unit = np.stack([np.cos(latitude) * np.cos(angle), np.cos(latitude) * np.sin(angle), np.sin(latitude + 0 * angle)])
    pole = np.array([0.0, 0.0, radii[2]])
    return _rings_to_mesh(center + np.moveaxis(unit, 0, -1) * radii, center - pole, center + pole)


def prism(outline: ArrayLike, bottom_m: float, top_m: float) -> Mesh:
    """A flat plate: an outline that is star-shaped about its mean, pulled up along z.

    Args:
        outline: Corners in the x-y plane, counter-clockwise seen from above, metres. Shape (N, 2).
        bottom_m: Height of the lower face.
        top_m: Height of the upper face.
    """
    outline = np.asarray(outline, dtype=np.float64)
    rings = np.stack([np.insert(outline, 2, height, axis=1) for height in (bottom_m, top_m)])
    center = outline.mean(axis=0)
    return _rings_to_mesh(rings, np.array([*center, bottom_m]), np.array([*center, top_m]))


def box(low: ArrayLike, high: ArrayLike, *, taper: float = 1.0) -> Mesh:
    """A box between two corners, its top shrunk about its middle by ``taper``.

    Args:
        low: Metres. Shape (3,).
        high: Metres. Shape (3,).
        taper: Size of the top face relative to the bottom face, in (0, 1].
    """
    low = np.asarray(low, dtype=np.float64)
    high = np.asarray(high, dtype=np.float64)
    middle = (low + high) / 2
    half = (high - low) / 2
    corners = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    rings = np.stack(
        [
            np.concatenate([middle[:2] + scale * half[:2] * corners, np.full((4, 1), z)], axis=1)
            for scale, z in ((1.0, low[2]), (taper, high[2]))
        ]
    )
    return _rings_to_mesh(rings, np.array([*middle[:2], low[2]]), np.array([*middle[:2], high[2]]))


def turned_profile(profile: Sequence[tuple[float, float]], *, sides: int = 12) -> Mesh:
    """A solid of revolution about z, such as a cup.

    Args:
        profile: (radius, z) from the bottom to the top, metres; both ends are closed by discs.
        sides: Corners of a cross-section.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rings = np.stack([np.insert(radius * circle, 2, z, axis=1) for radius, z in profile])
    return _rings_to_mesh(rings, np.array([0.0, 0.0, profile[0][1]]), np.array([0.0, 0.0, profile[-1][1]]))


def arch(center: ArrayLike, *, radius: float, thickness: float, corners: int = 6, sides: int = 5) -> Mesh:
    """Half a ring in the x-z plane that bulges toward -x, such as a cup's handle.

    Args:
        center: Middle of the ring's chord, metres. Shape (3,).
        radius: Of the ring's centre line.
        thickness: Radius of the bent rod.
        corners: Bones along the arch.
        sides: Corners of a cross-section.
    """
    x, y, z = np.asarray(center, dtype=np.float64)
    angle = np.linspace(-np.pi / 2, np.pi / 2, corners + 1)
    return limb([(x - radius * np.cos(a), y, z + radius * np.sin(a), thickness) for a in angle], sides=sides)
