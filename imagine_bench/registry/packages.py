"""Packages that offer anything, by their metadata: nothing of them is imported."""

from __future__ import annotations

from importlib.metadata import entry_points

from imagine_bench.errors import SetupError
from imagine_bench.registry.builtin import Guest, guests
from imagine_bench.registry.by_value import CodeByValue

MOTION = "imagine-bench-motion"
"""The plug-in of continuous control."""
TASK_GROUP = "imagine_bench.tasks"
AGENT_GROUP = "imagine_bench.agents"
ENCODER_GROUP = "imagine_bench.encoders"
REGRESSION_GROUP = "imagine_bench.regressions"
REGRESSOR_GROUP = "imagine_bench.regressors"
COMMAND_GROUP = "imagine_bench.commands"
STUDY_GROUP = "imagine_bench.studies"
WORLD_MODEL_GROUP = "imagine_bench.world_models"
"""Entry points in which installed packages make their offers: each the ``"module:attr"`` of a TaskEntry, AgentEntry,
EncoderEntry, RegressionSpec, RegressorEntry, Study or WorldModelEntry; of a plug-in of this suite, the function that
carries out a command."""


def guest_with(group: str, name: str) -> Guest | None:
    """The guest of this suite that offers a name in a group, installed or not; None where none does."""
    return next((guest for guest in guests() if name in guest.names.get(group, ())), None)


def is_ours(target: str | CodeByValue) -> bool:
    """Whether code is this suite's: the core's, or that of a guest of its own that needs no library of others."""
    top = str(target).partition(":")[0].partition(".")[0]
    return top in {"imagine_bench", *(guest.module for guest in guests() if guest.is_ours_alone)}


def absent_guests() -> list[Guest]:
    """The guests of this suite that are not installed here."""
    installed = guest_packages()
    return [guest for guest in guests() if guest.package not in installed]


def require_guest(package: str, doing: str) -> None:
    """Raise SetupError, with the line that installs it, where a plug-in of this suite is missing that does something.

    Args:
        package: The plug-in, as pip knows it.
        doing: The work that needs it, as the beginning of a sentence.
    """
    for guest in absent_guests():
        if guest.package == package:
            raise SetupError(
                f"{doing} needs the package {package}, which is not installed. Install it with: {guest.install}"
            )


def command(name: str) -> str:
    """The place of the function that carries out a command of a plug-in, as :func:`.loading.load` takes it.

    Raises SetupError, with the line that installs it, where the plug-in is missing.
    """
    (guest,) = (each for each in guests() if name in each.names.get(COMMAND_GROUP, {}))
    require_guest(guest.package, f"'imagine-bench {name}'")
    return guest.names[COMMAND_GROUP][name]


def guest_packages() -> dict[str, set[str]]:
    """The installed packages that offer anything, by name, and where their entries lie: names of top modules."""
    found: dict[str, set[str]] = {}
    everything = entry_points()
    for group in (each for each in everything.groups if each.startswith("imagine_bench.")):
        for point in everything.select(group=group):
            if point.dist:
                found.setdefault(point.dist.name, set()).add(point.module.partition(".")[0])
    return dict(sorted(found.items()))
