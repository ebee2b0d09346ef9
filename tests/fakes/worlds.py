"""The worlds of the registered tasks, for tests that would only repeat themselves on two tasks of one scene."""

from __future__ import annotations

import pytest

from imagine_bench import registry

WORLDS = tuple(name for name in registry.TASKS if registry.task(name).targets is not None)
"""The first task of each scene."""


def draw_quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let views for people be drawn without shadows and soft edges, which cost a software renderer 30 ms each."""

    from imagine_bench.tasks import macro_env
    from imagine_bench.tasks.rendering import View
    from imagine_bench.tasks.scene_reader import DRAWN_GROUPS

    def view(camera: str, width: int, height: int) -> View:
        return View(camera=camera, width=width, height=height, groups=DRAWN_GROUPS)

    monkeypatch.setattr(macro_env, "human_camera_view", view)
