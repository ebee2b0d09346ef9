"""imagine_bench: how far can imagination cut the real interaction a robot needs?

Importing it registers the Gymnasium environments and loads neither MuJoCo nor torch.
"""

from __future__ import annotations

import gymnasium

from imagine_bench.registry import TASKS

__version__ = "0.1.0"

for _entry in TASKS.values():
    if _entry.env_id not in gymnasium.registry:
        gymnasium.register(
            id=_entry.env_id,
            entry_point=_entry.env,
            max_episode_steps=_entry.horizon,
            kwargs=dict(_entry.options),
        )
