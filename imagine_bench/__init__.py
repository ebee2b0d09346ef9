"""imagine_bench: how far can imagination cut the real interaction a robot needs?

Importing it registers the Gymnasium environments and loads neither MuJoCo nor torch.
"""

from __future__ import annotations

from imagine_bench.registry import TASKS, register_env
from imagine_bench.registry.moved import keep_old_paths
from imagine_bench.version import __version__ as __version__

MOVED = {
    "imagine_bench.agents.library": "imagine_bench.agents.encoders",
    "imagine_bench.agents.library.latent_observation": "imagine_bench.agents.encoders.latent_observation",
    "imagine_bench.capabilities": "imagine_bench.interfaces.capabilities",
    "imagine_bench.data.episodes": "imagine_bench.interfaces.episodes",
    "imagine_bench.entrants": "imagine_bench.registry.entries",
    "imagine_bench.judge.models.outcomes": "imagine_bench.judge.truth",
    "imagine_bench.machine": "imagine_bench.registry.machine",
    "imagine_bench.regression.interfaces": "imagine_bench.interfaces.regression",
    "imagine_bench.studies": "imagine_bench.sweep.catalogue",
    "imagine_bench.studies.catalogue": "imagine_bench.sweep.catalogue",
    "imagine_bench.studies.study": "imagine_bench.sweep.grid",
    "imagine_bench.suite": "imagine_bench.sweep.catalogue",
    "imagine_bench.suite.experiments": "imagine_bench.sweep.catalogue",
    "imagine_bench.suite.run": "imagine_bench.sweep.run",
    "imagine_bench.suite.score": "imagine_bench.sweep.score",
    "imagine_bench.world_models": "imagine_bench.interfaces.model",
}
"""Where each module lies now, by the path that it had."""

keep_old_paths(MOVED)
for _entry in TASKS.values():
    register_env(_entry)
