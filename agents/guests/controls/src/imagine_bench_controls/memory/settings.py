"""Settings of the agents with memory; the thesis has none such (chapter 6 names them as future work)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeVar

from imagine_bench.agents.dqn_settings import HYPERPARAMETERS as PLAIN_DQN
from imagine_bench.agents.dqn_settings import DQNSettings
from imagine_bench.agents.imagination.inert import FILTERED
from imagine_bench.agents.imagination.settings import HYPERPARAMETERS as IMAGINATION
from imagine_bench.agents.imagination.settings import Settings
from imagine_bench.agents.settings import (
    COUNT,
    ConfigGroup,
    Hyperparameters,
    Override,
    between,
    flatten,
    replaced,
    setting,
)

from ..settings import PRIORITIES


@dataclass(frozen=True, kw_only=True)
class RecurrenceSettings:
    """The memory, and how it is learned (Kapturowski et al. 2019, R2D2)."""

    units: int = setting(256, COUNT)  #: numbers that are remembered: units of the GRU (Ha and Schmidhuber 2018)
    #: Macro-actions before a replayed transition that only bring its memory up to date, from the memory that was stored
    #: then.
    burn_in: int = setting(40, between(0, 1000))
    #: Macro-actions that are learned from, beginning with a replayed transition: the longest way of a gradient.
    sequence: int = setting(80, COUNT)


@dataclass(frozen=True, kw_only=True)
class RecurrentDQNSettings(DQNSettings):
    """All settings of the recurrent DQN; ``controller.batch_size`` counts sequences."""

    recurrence: RecurrenceSettings = field(default_factory=RecurrenceSettings)


@dataclass(frozen=True, kw_only=True)
class RecurrentSettings(Settings):
    """All settings of imagination with memory; ``model.batch_size`` counts sequences."""

    recurrence: RecurrenceSettings = field(default_factory=RecurrenceSettings)


_FAST: Mapping[str, Override] = {
    "recurrence.units": Override(64, "CPU time; one of a few cubes or objects is to be remembered"),
    "recurrence.burn_in": Override(10, "most episodes are that short, so that nothing stored is out of date"),
    "recurrence.sequence": Override(10, "as long as most episodes are"),
}
_SLOW_TARGET = Override(0.05, "without a target network the values of states that are still being learned swing")
_FAST_DQN = {**_FAST, "controller.target_rate": _SLOW_TARGET}
_FAST_IMAGINATION = {
    **_FAST_DQN,
    "model.batch_size": Override(32, "CPU time; each row is a sequence of several transitions"),
}
S = TypeVar("S", RecurrentDQNSettings, RecurrentSettings)


def _with_memory(
    kind: type[S], base: Hyperparameters[DQNSettings] | Hyperparameters[Settings], fast: Mapping[str, Override]
) -> Hyperparameters[S]:
    """The hyper-parameters of an agent without memory, with settings of its memory added.

    Replayed sequences are not prioritised, so the settings of priorities are unused.

    Args:
        kind: The class of the settings that are made.
        base: The hyper-parameters of the agent without memory.
        fast: Overrides of every set but ``published``.
    """
    groups = {}
    for name, group in base.groups.items():
        sets = {each: {**changes, **({} if each == "published" else fast)} for each, changes in group.sets.items()}
        groups[name] = ConfigGroup(replaced(kind(), flatten(group.published)), sets, unused=PRIORITIES)
    return Hyperparameters(groups)


DRQN = _with_memory(RecurrentDQNSettings, PLAIN_DQN, _FAST_DQN)
IMAGINATION_MEMORY = _with_memory(RecurrentSettings, IMAGINATION, _FAST_IMAGINATION).without(*FILTERED.has_no_effect)
