"""Old import paths of modules that moved. They keep working, and warn once in each process."""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

MOVED = {
    "imagine_bench.agents.library": "imagine_bench.agents.encoders",
    "imagine_bench.agents.library.latent_observation": "imagine_bench.agents.encoders.latent_observation",
    "imagine_bench.capabilities": "imagine_bench.interfaces.capabilities",
    "imagine_bench.data.episodes": "imagine_bench.interfaces.episodes",
    "imagine_bench.entrants": "imagine_bench.registry.entries",
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


class _MovedModules(MetaPathFinder, Loader):
    """Finds a module by its old path and fills it with the names of the new one."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return ModuleSpec(fullname, self, is_package=True) if fullname in MOVED else None

    def exec_module(self, module: ModuleType) -> None:
        new = MOVED[module.__name__]
        message = f"{module.__name__} is now {new}; import it from there. The old path goes in version 1.0."
        warnings.warn(message, DeprecationWarning, stacklevel=2)
        names = vars(importlib.import_module(new))
        module.__dict__.update({name: value for name, value in names.items() if not name.startswith("__")})


def keep_old_paths() -> None:
    """Let Python find modules by their old paths; a second call changes nothing."""
    if not any(isinstance(finder, _MovedModules) for finder in sys.meta_path):
        sys.meta_path.append(_MovedModules())
