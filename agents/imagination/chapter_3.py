"""Settings of chapter 3, pick-and-place with a human who changes their mind (thesis 3.2.2).

The chapter names no dropout, no max-norm, no discount and no size of the memories. Its second controller is "trained in
exactly the same manner, but on imaginary data": both memories are alike; imagined episodes end where the model says.
``full`` is ``quick`` with more seeds: without dropout the thesis' settings leave the filter nothing to compare.
"""

from __future__ import annotations

from ..config_groups import Deviation, Family
from ..settings import ControllerSettings, ImaginationSettings, MemorySettings, Settings, WorldModelSettings

_THESIS = Settings(
    model=WorldModelSettings(
        components=24,
        reward_hidden=(),
        termination_hidden=(),
        shared_hidden=(512, 256),
        dropout=0.0,
        max_norm=None,
        updates_per_step=4,
        batch_size=64,
        precision="float32",  # batches of 64 gain nothing from bfloat16
    ),
    controller=ControllerSettings(hidden=(512, 256), learning_rate=2.5e-4),
    imagination=ImaginationSettings(depth=50, weight_samples=1),
    memory=MemorySettings(imagined=50_000),
)

_QUICK: dict[str, Deviation] = {
    "model.members": Deviation(3, "the filter compares networks; chapter 3 has no dropout to draw them from"),
    "model.updates_per_step": Deviation(1, "CPU time: one update of 256 rows for four of 64"),
    "model.batch_size": Deviation(256, "as many rows a real step as the thesis' four updates; see updates_per_step"),
    "model.sigma_floor": Deviation(0.05, "below the encoder's own spread nothing is left to learn"),
    "controller.learning_rate": Deviation(1e-3, "imagined practice is short: a fresh controller learns on 3,000 steps"),
    "controller.target_rate": Deviation(0.02, "without a target network the values of a long chat with a human swing"),
    "controller.epsilon_decay": Deviation(
        0.001, "0.03 ends exploration after 100 steps, and the model never sees most of the 36 wrong macro-actions"
    ),
    "imagination.threshold": Deviation(0.1, "latents have unit variance: a tenth of it is doubt"),
}

_SMOKE: dict[str, Deviation] = {
    **_QUICK,
    "imagination.rehearsal_episodes": Deviation(50, "shows that every part works, within a minute"),
}

_PRESETS = {
    "smoke": _SMOKE,
    "quick": _QUICK,
    "thesis": {},
    "full": _QUICK,
    "sample_efficiency": _QUICK,
    "lessons": _QUICK,
}
CHAPTER_3 = Family(thesis=_THESIS, presets=_PRESETS)
