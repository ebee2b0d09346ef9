"""imagine_bench: how far can imagination cut the real interaction a robot needs?

Importing it registers the Gymnasium environments and loads neither MuJoCo nor torch.
"""

from __future__ import annotations

from imagine_bench.registry import TASKS, register_env
from imagine_bench.registry.moved import keep_old_paths
from imagine_bench.version import __version__ as __version__

keep_old_paths()
for _entry in TASKS.values():
    register_env(_entry)
