"""The worlds of the registered tasks, for tests that would only repeat themselves on two tasks of one scene."""

from __future__ import annotations

import pytest

from imagine_bench import registry

_MEASURED = [task for task in map(registry.task, registry.TASKS) if task.targets is not None]
WORLDS = tuple(task.id for i, task in enumerate(_MEASURED) if task.encoder not in [e.encoder for e in _MEASURED[:i]])
"""The first task of each scene."""


def draw_quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let views for people be drawn without shadows and soft edges, which cost a software renderer 0.1 s each."""

    from imagine_bench.tasks import observations, scene_reader
    from imagine_bench.tasks.rendering.cameras import DRAWN_GROUPS
    from imagine_bench.tasks.rendering.renderer import View

    def view(camera: str, width: int, height: int, *, quick: bool = False) -> View:
        return View(camera=camera, width=width, height=height, groups=DRAWN_GROUPS)

    for module in (observations, scene_reader):
        monkeypatch.setattr(module, "human_camera_view", view)
