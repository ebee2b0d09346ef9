"""imagine_bench: how far can imagination cut the real interaction a robot needs?

``bench`` compares agents on a task, ``load`` reads results, ``register_agent`` adds an agent of your own. Importing the
package registers the Gymnasium environments and loads neither MuJoCo nor torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from imagine_bench.registry import TASKS, register_env
from imagine_bench.registry.moved import keep_old_paths
from imagine_bench.version import __version__ as __version__

if TYPE_CHECKING:
    from imagine_bench.api import bench, load, register_agent

__all__ = ["bench", "load", "register_agent"]
LAZY = {
    "bench": "imagine_bench.api:bench",
    "load": "imagine_bench.api:load",
    "register_agent": "imagine_bench.api:register_agent",
}
"""The functions of the Python API, which are loaded when they are first used."""

MOVED = {
    "imagine_bench.agents.factored": "imagine_bench_factored",
    "imagine_bench.agents.factored.agent": "imagine_bench_factored.agent",
    "imagine_bench.agents.factored.factors": "imagine_bench_factored.factors",
    "imagine_bench.agents.factored.learned": "imagine_bench_factored.learned",
    "imagine_bench.agents.factored.learned_perception": "imagine_bench_factored.perception",
    "imagine_bench.agents.factored.perception": "imagine_bench_factored.perception",
    "imagine_bench.agents.factored.settings": "imagine_bench_factored.settings",
    "imagine_bench.agents.factored_own": "imagine_bench_factored",
    "imagine_bench.agents.factored_own.agent": "imagine_bench_factored.learned",
    "imagine_bench.agents.library": "imagine_bench.agents.encoders",
    "imagine_bench.agents.library.latent_observation": "imagine_bench.agents.encoders.latent_observation",
    "imagine_bench.agents.memory": "imagine_bench_controls.memory",
    "imagine_bench.agents.memory.agent": "imagine_bench_controls.memory.agent",
    "imagine_bench.agents.memory.imagination": "imagine_bench_controls.memory.imagination",
    "imagine_bench.agents.memory.recurrence": "imagine_bench_controls.memory.sequences",
    "imagine_bench.agents.memory.settings": "imagine_bench_controls.memory.settings",
    "imagine_bench.agents.regressors": "imagine_bench_regression",
    "imagine_bench.agents.regressors.regressor": "imagine_bench_regression.regressor",
    "imagine_bench.agents.regressors.settings": "imagine_bench_regression.settings",
    "imagine_bench.bench": "imagine_bench.running",
    "imagine_bench.bench.bench": "imagine_bench.running.bench",
    "imagine_bench.bench.launchers": "imagine_bench.running.launchers",
    "imagine_bench.bench.launchers.jobs": "imagine_bench.running.launchers.jobs",
    "imagine_bench.capabilities": "imagine_bench.interfaces.capabilities",
    "imagine_bench.certificates": "imagine_bench.exact",
    "imagine_bench.certificates.certificate": "imagine_bench.exact.certificate",
    "imagine_bench.data.episodes": "imagine_bench.interfaces.episodes",
    "imagine_bench.entrants": "imagine_bench.registry.entries",
    "imagine_bench.interfaces.motion": "imagine_bench_motion.judge.interface",
    "imagine_bench.judge.models.outcomes": "imagine_bench.judge.truth",
    "imagine_bench.judge.motion": "imagine_bench_motion.judge",
    "imagine_bench.judge.motion.scores": "imagine_bench_motion.judge.scores",
    "imagine_bench.judge.values": "imagine_bench.exact.values",
    "imagine_bench.machine": "imagine_bench.registry.machine",
    "imagine_bench.recording.motion": "imagine_bench_motion.control.recording",
    "imagine_bench.regression.interfaces": "imagine_bench.interfaces.regression",
    "imagine_bench.recording.regression": "imagine_bench_regression.recordings",
    "imagine_bench.report.plots": "imagine_bench.report.figures",
    "imagine_bench.store.archive": "imagine_bench.store.loading",
    "imagine_bench.studies": "imagine_bench.sweep.grid",
    "imagine_bench.studies.catalogue": "imagine_bench.sweep.grid",
    "imagine_bench.studies.study": "imagine_bench.sweep.grid",
    "imagine_bench.suite": "imagine_bench.sweep.grid",
    "imagine_bench.suite.experiments": "imagine_bench.sweep.grid",
    "imagine_bench.suite.run": "imagine_bench.sweep.run",
    "imagine_bench.suite.score": "imagine_bench.sweep.score",
    "imagine_bench.tasks.continuous.demonstrator": "imagine_bench_motion.control.demonstrator",
    "imagine_bench.tasks.continuous.goals": "imagine_bench_motion.control.goals",
    "imagine_bench.tasks.robot_ik": "imagine_bench_regression.robot_ik",
    "imagine_bench.tasks.toy_regression": "imagine_bench_regression.toy_regression",
    "imagine_bench.tools.demonstrations": "imagine_bench_motion.control.datasets",
    "imagine_bench.world_models": "imagine_bench.interfaces.model",
}
"""Where each module lies now, by the path that it had."""
MOVED_NAMES = {
    "imagine_bench.agents.factored_own.agent:OwnPerceptionAgent": (
        "imagine_bench_factored.learned:LearnedPerceptionAgent"
    ),
    "imagine_bench.entrants:Entrant": "imagine_bench.registry.entries:AgentConfiguration",
    "imagine_bench.entrants:entrant": "imagine_bench.registry.entries:parse_configuration",
    "imagine_bench.interfaces:Sight": "imagine_bench.interfaces:ObservationModel",
    "imagine_bench.registry:Entrant": "imagine_bench.registry:AgentConfiguration",
    "imagine_bench.registry:entrant": "imagine_bench.registry:parse_configuration",
    "imagine_bench.registry:OBSERVERS": "imagine_bench.cli.observers:OBSERVERS",
    "imagine_bench.registry:TASK_TYPES": "imagine_bench.running.bench:TASK_TYPES",
    "imagine_bench.store.archive:load_archive": "imagine_bench.store.loading:load_so_far",
}
"""Where each name lies now, by the place that it had: names of moved modules, and of those loaded here."""

keep_old_paths(__name__, MOVED | MOVED_NAMES)
for _entry in TASKS.values():
    register_env(_entry)
