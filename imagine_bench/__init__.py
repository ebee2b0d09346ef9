"""imagine_bench: how far can imagination cut the real interaction a robot needs?

Importing it registers the Gymnasium environments and loads neither MuJoCo nor torch.
"""

from __future__ import annotations

from imagine_bench.moved import keep_old_paths
from imagine_bench.registry import TASKS, register_env

__version__ = "0.1.0"

keep_old_paths()
for _entry in TASKS.values():
    register_env(_entry)
