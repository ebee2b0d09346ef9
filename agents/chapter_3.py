"""Settings of chapter 3, pick-and-place with a human who changes their mind (thesis 3.2.2).

The chapter names no dropout, no max-norm, no discount and no size of the memories. Its second controller is "trained in
exactly the same manner, but on imaginary data": both memories are alike; imagined episodes end where the model says.
"""

from __future__ import annotations

from .family import Deviation, Family
from .settings import ControllerSettings, ImaginationSettings, MemorySettings, Settings, WorldModelSettings

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
    imagination=ImaginationSettings(depth=50, weight_samples=1, reduction="max"),
    memory=MemorySettings(imagined=50_000),
)

_QUICK: dict[str, Deviation] = {}
_SMOKE: dict[str, Deviation] = {**_QUICK}

CHAPTER_3 = Family(thesis=_THESIS, presets={"smoke": _SMOKE, "quick": _QUICK, "thesis": {}, "full": {}})
