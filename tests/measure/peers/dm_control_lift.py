"""dm_control's manipulation task lift_brick; it has 25 Hz, and no camera at the wrist."""

from __future__ import annotations

import numpy as np
from dm_control import composer
from dm_control.manipulation import lift
from dm_control.manipulation.shared import cameras, observations
from loop import IMAGE_PX, Images, Lane, run

CLOSE = "front_close"


def make(images: Images) -> Lane:
    """One environment, as ``manipulation.load`` makes it, with images of 64×64 in place of 84×84."""
    settings = observations.PERFECT_FEATURES
    if images.count:
        camera = observations.VISION.camera._replace(height=IMAGE_PX, width=IMAGE_PX)
        settings = observations.VISION._replace(camera=camera)
    task = lift._lift(settings, "duplo")
    names = [CLOSE] if images.count else []
    if images.count == 2:
        more = cameras.add_camera_observables(task.root_entity, settings, cameras.FRONT_FAR)
        task._task_observables.update(more)
        names.append("front_far")
    if images.plain:
        scene = task.root_entity.mjcf_model
        scene.visual.quality.shadowsize = 0
        scene.visual.quality.offsamples = 0
        for light in scene.find_all("light"):
            light.castshadow = False
        for material in scene.find_all("material"):
            material.reflectance = 0.0
    env = composer.Environment(task, time_limit=10.0, random_state=0)

    def step(action: np.ndarray) -> tuple[bool, list[np.ndarray]]:
        moment = env.step(action)
        return moment.last(), [moment.observation[name][0] for name in names]

    spec = env.action_spec()
    return Lane(
        env.reset, step, spec.minimum, spec.maximum, env.physics.model._model, task.physics_steps_per_control_step
    )


if __name__ == "__main__":
    run(make)
