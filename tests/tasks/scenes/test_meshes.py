"""Meshes of scenes: closed, facing outward, and as large as the solids they stand for."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from imagine_bench.tasks.arrows.scene import arrow_outline
from imagine_bench.tasks.scenes import hand, objects
from imagine_bench.tasks.scenes.meshes import Mesh, box, stack


def signed_volume_m3(mesh: Mesh) -> float:
    """Enclosed volume; positive if every part is closed and its faces look outward (overlaps count twice)."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


PARTS = {
    "arrow": stack([arrow_outline()] * 2, (0.0, 0.001), arrow_outline().mean(axis=0)),
    **hand.hand_meshes(),
    **hand.open_hand_meshes(),
    **{part.__name__: part() for part in (objects.car_body, objects.car_trim, objects.cup_body, objects.cup_inside)},
}


@pytest.mark.parametrize("mesh", PARTS.values(), ids=PARTS)
def test_meshes_are_closed_and_face_outward(mesh):
    edges = Counter(tuple(edge) for face in mesh.faces.tolist() for edge in zip(face, face[1:] + face[:1], strict=True))
    assert all(edges[b, a] == count == 1 for (a, b), count in edges.items())
    assert signed_volume_m3(mesh) > 0


def test_volumes_of_flat_solids_are_exact():
    outline = arrow_outline()
    x, y = outline.T
    area = 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
    assert signed_volume_m3(stack([outline, outline], (-0.1, 0.2))) == pytest.approx(0.3 * area)
    assert signed_volume_m3(box((0, 0, 0), (1, 2, 3))) == pytest.approx(6.0)
    assert signed_volume_m3(box((0, 0, 0), (1, 1, 1), taper=0.5)) == pytest.approx((1 + 0.25 + 0.5) / 3)


@pytest.mark.parametrize("part", ["hand", "palm"])
def test_people_see_every_limb_that_agents_see(part):
    coarse = PARTS[part].vertices
    smooth = PARTS[f"{part}_smooth"].vertices
    apart_m = np.linalg.norm(coarse[:, None] - smooth[None], axis=2).min(axis=1)
    assert apart_m.max() < 0.006
