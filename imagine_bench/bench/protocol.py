"""A protocol is data: what is compared, on what, how long, how often. Its hash stands in every result."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
from dataclasses import dataclass
from typing import Any, Self

from imagine_bench.errors import InvalidValueError, require_known
from imagine_bench.interfaces import APPEARANCES, DEVICES, EXECUTIONS
from imagine_bench.registry import agent_entry, task, task_entry
from imagine_bench.seeding import SEEDS, TUNING_SEEDS, is_tuning_seed

_THESIS_AGENTS = ("dqn", "imagination", "imagination_uncertainty")
_ALL_AGENTS = ("random", "oracle", *_THESIS_AGENTS)
_THESIS_BUDGETS = (250, 500, 1000, 1500, 2000, 3000, 4000, 5000, 6000)

_AFTER_EPISODES = 100
_FIRST_WAVE = 2000
"""Real episodes to which all runs are taken first: the thesis' smallest budget, and below it waiting would not pay."""


def digest(values: Any) -> str:
    """Twelve hex digits that change when anything in JSON-like values does."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:12]


class ProtocolData:
    """What protocols of every kind can do, being dataclasses of JSON-like values."""

    def as_dict(self) -> dict[str, Any]:
        """A JSON-serialisable copy; without a digest of settings where there is none, as in protocols from before."""
        values: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(self)))  # type: ignore[call-overload]
        return {name: value for name, value in values.items() if name != "settings_digest" or value}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """The inverse of :meth:`as_dict`."""
        tuples = {key: tuple(value) if isinstance(value, list) else value for key, value in data.items()}
        tuples["overrides"] = tuple((name, value) for name, value in tuples.get("overrides", ()))
        return cls(**tuples)

    @property
    def hash(self) -> str:
        """Twelve hex digits that change when anything in the protocol does."""
        return digest(self.as_dict())

    @property
    def stages(self) -> tuple[int | None, ...]:
        """The order of work: all runs come to each of these budgets before any goes on; None is the end.

        A long bench that is stopped early is then a whole bench of fewer episodes.
        """
        return (None,)


@dataclass(frozen=True, kw_only=True)
class Protocol(ProtocolData):
    """One comparison, completely specified.

    Attributes:
        task: Registered task.
        preset: Name of this protocol and of the agents' settings preset.
        settings: Family of settings that the preset belongs to, as the task names it.
        agents: Registered agents, in the order of the report.
        seeds: One training run a seed and agent; each in [0, 2**24). Seeds from TUNING_SEEDS on are for choosing
            settings and are tested on starts that no reported run meets; the two kinds never mix.
        budgets: Real training episodes at which the agent is evaluated, ascending.
        evaluation_episodes: Greedy test episodes at each budget, the same starts for every agent.
        execution: ``"physics"`` or ``"kinematic"``.
        appearance: ``"clean"``, ``"mild"`` or ``"strong"``.
        overrides: Agent settings that replace the preset's, as sorted (dotted name, value) pairs.
        settings_digest: :func:`digest` of every setting of every learner: a preset may be another one tomorrow, and
            what was run with it is then another bench. Empty in a protocol that :func:`.bench.plan` did not make.
        open_loop_starts: Real frames from which open-loop imagination is compared with the rules at each budget.
        sampled_futures: Futures imagined from each macrostate of play and macro-action, and compared with the rules'
            distribution at each budget; 0 asks for none.
        recorded_episodes: Real episodes in each recording; 0 records none.
        encoder: The encoder's identity, ``"<name>@<12 hex digits of its content>"``; None if no agent needs one.
        codes: That of the encoder for the agents that see codes of parts; None if there is no such agent.
        device: ``"cpu"`` or ``"cuda"``, where the agents compute: the bits of a result depend on it.
        after: Tasks of the same world that learners are trained on before, in this order; what they know of the
            world is carried over, what is rewarded is learned anew. Budgets count episodes of ``task`` alone.
        after_episodes: Real training episodes on each of them.
        demonstrations: Training episodes, the first ones, that the bench's demonstrator plays while learners merely
            observe; they are real episodes as any, and budgets count them.
        questions: Most questions that learners may ask a teacher in a training episode.
    """

    task: str
    preset: str
    settings: str = "chapter_5"
    agents: tuple[str, ...] = _ALL_AGENTS
    seeds: tuple[int, ...] = (0, 1, 2)
    budgets: tuple[int, ...] = (100, 250, 500, 1000)
    evaluation_episodes: int = 200
    execution: str = "physics"
    appearance: str = "clean"
    overrides: tuple[tuple[str, Any], ...] = ()
    settings_digest: str = ""
    open_loop_starts: int = 100
    sampled_futures: int = 16
    recorded_episodes: int = 5
    encoder: str | None = None
    codes: str | None = None
    device: str = "cpu"
    after: tuple[str, ...] = ()
    after_episodes: int = _AFTER_EPISODES
    demonstrations: int = 0
    questions: int = 0

    def __post_init__(self) -> None:
        task_entry(self.task)
        for agent in self.agents:
            agent_entry(agent)
        require_known("appearance", self.appearance, APPEARANCES)
        require_known("execution", self.execution, EXECUTIONS)
        require_known("device", self.device, DEVICES)
        require_ascending("budgets", self.budgets, at_least=1)
        require_seeds(self.seeds)
        if not self.agents or len(set(self.agents)) != len(self.agents):
            raise InvalidValueError(f"agents {self.agents} must be at least one name, none of them twice.")
        if self.evaluation_episodes < 1:
            raise InvalidValueError(f"evaluation_episodes is {self.evaluation_episodes}; give at least 1.")
        require_same_world(self.task, self.after)
        if self.after_episodes < 1:
            raise InvalidValueError(f"after_episodes is {self.after_episodes}; give at least 1.")
        if not self.after and self.after_episodes != _AFTER_EPISODES:
            raise InvalidValueError(
                f"after_episodes is {self.after_episodes}, but no task comes before; give it in after."
            )
        for name in ("demonstrations", "questions", "open_loop_starts", "sampled_futures", "recorded_episodes"):
            if getattr(self, name) < 0:
                raise InvalidValueError(f"{name} is {getattr(self, name)}; give at least 0.")

    def work(self, agent: str, until: int | None = None) -> int:
        """Episodes that a run of this agent plays as far as the budget ``until``, for training and for tests."""
        budgets = [budget for budget in self.budgets if until is None or budget <= until]
        tests = self.evaluation_episodes
        return self.episodes_before + budgets[-1] + len(budgets) * tests if agent_entry(agent).learns else tests

    @property
    def episodes_before(self) -> int:
        """Real training episodes on earlier tasks."""
        return len(self.after) * self.after_episodes

    @property
    def stages(self) -> tuple[int | None, ...]:
        """See :class:`ProtocolData`: the thesis' smallest budget, then each one after it."""
        return (*(budget for budget in self.budgets[:-1] if budget >= _FIRST_WAVE), None)

    def as_dict(self) -> dict[str, Any]:
        """A JSON-serialisable copy; without the younger fields where they are at rest, as in protocols from before."""
        resting = {
            *(name for name in ("codes", "after", "demonstrations", "questions") if not getattr(self, name)),
            *(() if self.after else ("after_episodes",)),
        }
        return {name: value for name, value in super().as_dict().items() if name not in resting}

    def encoder_of(self, kind: str) -> str | None:
        """Identity of the encoder for the agents that take this kind."""
        return self.codes if kind == "codes" else self.encoder


PRESETS: dict[str, dict[str, Any]] = {
    "smoke": {
        "seeds": (0,),
        "budgets": (10, 20),
        "evaluation_episodes": 20,
        "open_loop_starts": 20,
        "sampled_futures": 4,
        "recorded_episodes": 2,
    },
    "quick": {"agents": (*_ALL_AGENTS, "factored")},
    "thesis": {
        "agents": _THESIS_AGENTS,
        "seeds": tuple(range(5)),
        "budgets": _THESIS_BUDGETS,
        "evaluation_episodes": 1000,
    },
    "full": {"agents": _ALL_AGENTS, "seeds": tuple(range(20)), "budgets": _THESIS_BUDGETS, "evaluation_episodes": 1000},
    "sample_efficiency": {
        "agents": ("factored",),
        "seeds": tuple(range(5)),
        "budgets": tuple(range(20, 201, 20)),
        "evaluation_episodes": 1000,
        "recorded_episodes": 2,
    },
    "lessons": {
        "agents": ("factored",),
        "seeds": tuple(range(5)),
        "budgets": (10, 20, 30, 40, 60, 80, 100),
        "evaluation_episodes": 100,
        "execution": "kinematic",
        "open_loop_starts": 0,
        "sampled_futures": 0,
        "recorded_episodes": 0,
    },
}
"""What each preset changes, but where a task says otherwise: ``smoke`` shows that everything works, ``quick`` is the
default, ``thesis`` is tables 5.1-5.4 as printed, ``full`` has seeds enough to see the filter's gain (5 do not, by the
thesis' own spreads), ``sample_efficiency`` counts the first episodes of agents that need few, ``lessons`` does so
in little time, to compare many ways of being taught."""


def protocol(task_name: str, preset: str = "quick", **changes: Any) -> Protocol:
    """The protocol of a preset as the task has it, with ``changes`` to single fields.

    Raises:
        UnknownNameError: Unknown task, preset, agent, appearance or execution.
        InvalidValueError: A value out of range.
    """
    require_known("preset", preset, PRESETS)
    spec = task(task_name)
    values = {"settings": spec.settings, **PRESETS[preset], **spec.presets.get(preset, {}), **changes}
    if "seeds" in values:  # in whatever order they are given, it is the same bench
        values["seeds"] = tuple(sorted(values["seeds"]))
    return Protocol(task=task_name, preset=preset, **values)


def require_ascending(name: str, values: tuple[int, ...], *, at_least: int) -> None:
    """Raise InvalidValueError unless values are different integers, ascending, of at least ``at_least``."""
    ascending = all(a < b for a, b in itertools.pairwise(values))
    if not values or not ascending or values[0] < at_least:
        raise InvalidValueError(
            f"{name} {values} must be one or more different integers of at least {at_least}, ascending."
        )


def require_same_world(name: str, earlier: tuple[str, ...]) -> None:
    """Raise InvalidValueError for an earlier task that is not of the world of task ``name``, or UnknownNameError.

    Tasks are of one world if their frames are preprocessed and encoded alike and their macro-actions have one meaning.
    """
    for other in earlier:
        task_entry(other)
        for field in ("encoder", "preprocessing", "action_names"):
            here, there = getattr(task(name), field), getattr(task(other), field)
            if here != there:
                raise InvalidValueError(
                    f"{name} cannot come after {other}: what is known of one world is of no use in another ({field} is "
                    f"{there!r} there and {here!r} here). Give tasks of one family, such as arrow_puzzle and "
                    "arrow_puzzle_hard."
                )


def require_seeds(seeds: tuple[int, ...]) -> None:
    """Raise InvalidValueError for seeds that are none, equal or out of range, and for tuning among reported ones."""
    if not seeds or len(set(seeds)) != len(seeds) or not all(0 <= seed < SEEDS for seed in seeds):
        raise InvalidValueError(f"seeds {seeds} must be one or more different integers from 0 to {SEEDS - 1}.")
    if len({is_tuning_seed(seed) for seed in seeds}) > 1:
        raise InvalidValueError(
            f"seeds {seeds} mix tuning seeds (from {TUNING_SEEDS} on, tested on starts of their own) with "
            "reported ones; give them to separate benches."
        )
