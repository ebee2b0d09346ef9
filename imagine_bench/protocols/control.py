"""The protocol of a bench of agents that act: the agents, the task, the budgets and the tests."""

from __future__ import annotations

import dataclasses
from collections.abc import ItemsView, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, cast

from imagine_bench.appearance import appearance_name, appearance_typed
from imagine_bench.errors import ArtefactError, InvalidValueError, UnableError, brief, require_known
from imagine_bench.exact.beliefs import optimal_policy_of
from imagine_bench.exact.splits import StartingFrom, split_of
from imagine_bench.interfaces import (
    EXECUTIONS,
    FRAME_PX,
    OBSERVATION_SIZES_PX,
    OBSERVATIONS,
    PROPRIO_SIZE,
    AgentContext,
    ExactWorld,
    PhysicsSettings,
    Rules,
    TaskSpec,
    appearance_of_tests,
)
from imagine_bench.protocols.data import (
    MOST,
    OPTIONAL_IN_HASH,
    ProtocolData,
    RunSpec,
    package_digests,
    require_different,
)
from imagine_bench.protocols.presets import ALL_AGENTS, PRESETS
from imagine_bench.registry import (
    AGENT_GROUP,
    agent_entry,
    installed_of,
    own_settings,
    package_code,
    spelled,
    task,
    task_entry,
)
from imagine_bench.registry import task_name as canonical
from imagine_bench.registry.by_value import CodeByValue
from imagine_bench.registry.entries import parse_configuration
from imagine_bench.rules import facts
from imagine_bench.seeding import SeedTree
from imagine_bench.values import Setting

TASK_CODE = "task "
"""Beginning of the names of tasks in :attr:`.ProtocolData.code`; no agent's name has a space."""
_AFTER_EPISODES = 100
_AT_LEAST = {
    "after_episodes": 1,
    "demonstrations": 0,
    "queries": 0,
    "evaluation_episodes": 1,
    "most_looks": 1,
    "open_loop_starts": 0,
    "sampled_futures": 0,
    "recorded_episodes": 0,
    "recorded_seeds": 0,
}


@dataclass(frozen=True, kw_only=True)
class WorldSection:
    """The world, in training and in tests."""

    execution: str = "physics"  #: ``"physics"`` or ``"kinematic"``
    appearance: str = "clean"  #: As :func:`imagine_bench.appearance.appearance_name` gives it
    #: The physics of grasping: settings of :class:`.PhysicsSettings` that are not the scene's own, as sorted
    #: (name, value) pairs.
    physics: tuple[tuple[str, float | str], ...] = field(default=(), metadata=OPTIONAL_IN_HASH)
    #: The observation of agents: parts of :data:`.interfaces.OBSERVATIONS`, separated by commas.
    observation: str = field(default=OBSERVATIONS[0], metadata=OPTIONAL_IN_HASH)
    observation_size: int = field(default=FRAME_PX, metadata=OPTIONAL_IN_HASH)  #: Edge of its images in pixels
    #: Training and tests start from different macrostates, ``"plan_length=2@<12 hex digits>"``: see :mod:`.splits`.
    split: str | None = field(default=None, metadata=OPTIONAL_IN_HASH)

    def _check_world(self) -> None:
        """Write each choice in one way. Raises InvalidValueError or UnknownNameError for a value out of range."""
        require_known("execution", self.execution, EXECUTIONS)
        object.__setattr__(self, "appearance", appearance_name(self.appearance))
        settings = dataclasses.asdict(PhysicsSettings.of(dict(self.physics)))
        changed = settings.items() - dataclasses.asdict(PhysicsSettings()).items()
        object.__setattr__(self, "physics", tuple(sorted(changed)))
        if self.physics and self.execution == "kinematic":
            raise InvalidValueError("Physics settings change nothing in kinematic execution; leave one of them out.")
        parts = tuple(self.observation.split(","))
        for part in parts:
            require_known("observation", part, OBSERVATIONS)
        require_different("observation", parts)
        object.__setattr__(self, "observation", ",".join(sorted(parts, key=OBSERVATIONS.index)))
        low, high = OBSERVATION_SIZES_PX
        if not low <= self.observation_size <= high:
            raise InvalidValueError(f"observation_size is {brief(self.observation_size)}; give {low} to {high} pixels.")

    @property
    def shows_frames_alone(self) -> bool:
        """Whether agents see 64 x 64 frames and nothing else."""
        return (self.observation, self.observation_size) == (OBSERVATIONS[0], FRAME_PX)

    @property
    def world(self) -> dict[str, Setting]:
        """The arguments of this protocol's environments, but for their appearance."""
        made: dict[str, Setting] = {"execution": self.execution}
        if self.physics:
            made["physics"] = dict(self.physics)
        if not self.shows_frames_alone:
            made["observation"] = self.observation
            made["size"] = self.observation_size
        return made


@dataclass(frozen=True, kw_only=True)
class LearnerSection:
    """The choices that make learners; see also ``overrides`` and ``device`` of :class:`.ProtocolData`."""

    config_group: str = "chapter_5"  #: config group of the agents' settings, as the task names it
    #: Set of values of that group for every learner: ``"minimal"``, ``"fast"`` or ``"published"``.
    hyperparameters: str = "fast"
    #: The encoder's identity, ``"<name>@<12 hex digits of its content>"``; None if no agent needs one.
    encoder: str | None = None
    #: That of the encoder for the agents that see codes of parts; None if there is no such agent.
    codes: str | None = None

    def encoder_of(self, kind: str) -> str | None:
        """Return the identity of the encoder for the agents that take this kind."""
        return self.codes if kind == "codes" else self.encoder


@dataclass(frozen=True, kw_only=True)
class BudgetSection:
    """The experience of learners: real episodes, and help in them."""

    #: Real training episodes at which the agent is evaluated, ascending.
    budgets: tuple[int, ...] = (100, 250, 500)
    #: Tasks of the same world that learners are trained on before, in this order; their knowledge of the world is
    #: carried over, rewards are learned anew. Budgets count episodes of ``task`` alone.
    after: tuple[str, ...] = ()
    after_episodes: int = _AFTER_EPISODES  #: Real training episodes on each of them
    #: Whether learners are not told that another task begins: the rules change within one run, and episodes are counted
    #: on. No knowledge is carried over on purpose, so any learner takes it.
    unannounced: bool = field(default=False, metadata=OPTIONAL_IN_HASH)
    #: Training episodes, the first ones, that the bench's demonstrator plays while learners merely observe; they are
    #: real episodes as any, and budgets count them.
    demonstrations: int = 0
    queries: int = 0  #: Most oracle queries of a learner in a training episode
    #: The first training episodes are those of a dataset, ``"<policy>-<episodes>@<12 hex digits of its content>"``;
    #: they are real episodes as any, and budgets count them.
    dataset: str | None = field(default=None, metadata=OPTIONAL_IN_HASH)
    #: Reward on top of the world's own for a macro-action of its own that an optimal agent could have chosen, and less
    #: for another: a teacher's feedback in training. Demonstrations and earlier tasks get none.
    feedback: float = field(default=0.0, metadata=OPTIONAL_IN_HASH)
    #: Probability with which the teacher says the opposite, at most 0.5.
    feedback_error: float = field(default=0.0, metadata=OPTIONAL_IN_HASH)

    def _check_budget(self) -> None:
        """Raise InvalidValueError for a value out of range, and for two that exclude each other."""
        in_range = all(1 <= budget <= MOST for budget in self.budgets)
        if not self.budgets or not in_range or list(self.budgets) != sorted({*self.budgets}):
            raise InvalidValueError(
                f"budgets {brief(self.budgets)} must be one or more different integers from 1 to {MOST:,}, ascending."
            )
        if not 0.0 <= self.feedback <= MOST or not 0.0 <= self.feedback_error <= (0.5 if self.feedback else 0.0):
            raise InvalidValueError(
                f"feedback is {brief(self.feedback)} and feedback_error {brief(self.feedback_error)}; give a reward of "
                f"at least 0 and at most {MOST:,}, and with it a probability of at most 0.5."
            )
        if self.dataset is not None and self.demonstrations:
            raise InvalidValueError("Both a dataset and demonstrations would come first; give one of them.")
        for name, usual in (("after_episodes", _AFTER_EPISODES), ("unannounced", False)):
            if not self.after and getattr(self, name) != usual:
                raise InvalidValueError(f"{name} is {getattr(self, name)}, but no task comes before; give it in after.")

    @property
    def helps(self) -> tuple[str, ...]:
        """The options of training that are in use: the fields of this section that are not as by default."""
        options = [each for each in dataclasses.fields(BudgetSection) if each.name != "budgets"]
        return tuple(each.name for each in options if getattr(self, each.name) != each.default)

    @property
    def episodes_before(self) -> int:
        """Real training episodes on earlier tasks."""
        return len(self.after) * self.after_episodes


@dataclass(frozen=True, kw_only=True)
class EvaluationSection:
    """The tests of agents, and the measurements and recordings beside them."""

    evaluation_episodes: int = 200  #: Greedy test episodes at each budget, the same starts for every agent
    #: Appearance of the tests where it is another one than the training's.
    test_appearance: str | None = field(default=None, metadata=OPTIONAL_IN_HASH)
    #: Real frames from which open-loop imagination is compared with the rules at each budget.
    open_loop_starts: int = 100
    #: Futures that benches of before 2026-11-25 sampled; nothing reads it now.
    sampled_futures: int = 0
    recorded_episodes: int = 5  #: Real episodes in each recording; 0 records none
    #: Of how many seeds runs are recorded, the first ones; 0 for all
    recorded_seeds: int = field(default=0, metadata=OPTIONAL_IN_HASH)
    #: Comparisons declared beforehand: an agent, and the agent that it should beat at the last budget. Their p-values
    #: are corrected for one another alone.
    headlines: tuple[tuple[str, str], ...] = field(default=(), metadata=OPTIONAL_IN_HASH)
    #: How often the headlines are tested at most, with more seeds each time: see :mod:`.running.headlines`.
    most_looks: int = field(default=1, metadata=OPTIONAL_IN_HASH)
    #: Agents of which fewer seeds are run, each with its last seed.
    few_seeds: tuple[tuple[str, int], ...] = field(default=(), metadata=OPTIONAL_IN_HASH)


@dataclass(frozen=True, kw_only=True)
class Protocol(WorldSection, LearnerSection, BudgetSection, EvaluationSection, ProtocolData):
    """A comparison of agents that act, in four sections; see :class:`.ProtocolData` for the part that it shares with
    others.

    A new option is a field of one section, checked there. Files and hashes have all fields side by side.
    """

    agents: tuple[str, ...] = ALL_AGENTS  #: Agents, also with settings of their own (:mod:`.entries`)
    seeds: tuple[int, ...] = (0, 1, 2)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, at_least in _AT_LEAST.items():
            value = getattr(self, name)
            if not at_least <= value <= MOST:
                raise InvalidValueError(f"{name} is {brief(value)}; give {at_least:,} to {MOST:,}.")
        self._check_world()
        self._check_budget()
        if self.test_appearance is not None:
            object.__setattr__(self, "test_appearance", appearance_name(self.test_appearance))
        if self.dataset is not None and not self.shows_frames_alone:
            raise InvalidValueError("A dataset holds 64 x 64 frames alone; leave the observation as it is by default.")

    def seeds_of(self, agent: str) -> tuple[int, ...]:
        """The seeds that an agent is run with."""
        last = dict(self.few_seeds).get(agent, self.seeds[-1])
        return tuple(seed for seed in self.seeds if seed <= last)

    def code_places(self) -> dict[str, str]:
        """As :meth:`.ProtocolData.code_places`."""
        made_by = {parse_configuration(agent).agent: agent_entry(agent).make for agent in self.agents}
        places = {name: make for name, make in made_by.items() if isinstance(make, str)}
        tasks = {name.partition(":")[0]: task_entry(name).spec for name in (self.task, *self.after)}
        return {**places, **{f"{TASK_CODE}{name}": place for name, place in tasks.items()}}

    def work(self, agent: str) -> int:
        """Return the episodes that a run of this agent plays, for training and for tests."""
        if not agent_entry(agent).learns:
            return self.evaluation_episodes
        return self.episodes_before + self.budgets[-1] + len(self.budgets) * self.evaluation_episodes

    @property
    def appearance_in_tests(self) -> str:
        """The appearance that tests have; of finitely many looks, those kept for tests."""
        return appearance_of_tests(self.test_appearance or self.appearance)

    def spec(self, *, testing: bool) -> TaskSpec:
        """The task with the starts that training or tests have. Raises InvalidValueError: another split than here."""
        return spec_of(self.task, self.split, testing=testing)

    @property
    def appearance_in_words(self) -> str:
        """The appearance in words: ``clean``, or ``clean, tested at strong``; and the observations of agents beside
        frames.
        """
        other = self.test_appearance not in (None, self.appearance)
        words = [appearance_typed(self.appearance)]
        if other and self.test_appearance is not None:
            words.append(f"tested at {appearance_typed(self.test_appearance)}")
        if not self.shows_frames_alone:
            privileged = " (privileged)" if "state" in self.observation else ""
            words.append(f"agents see {self.observation} at {self.observation_size} pixels{privileged}")
        return ", ".join(words)


def spec_of(name: str, split: str | None, *, testing: bool) -> TaskSpec:
    """See :meth:`Protocol.spec`."""
    spec = task(name)
    if split is None:
        return spec
    found = split_of(spec.rules, split)
    rules = cast("Rules", StartingFrom(spec.rules, found.test if testing else found.train))
    return dataclasses.replace(spec, rules=rules, facts=partial(facts, rules, spec.horizon))


def usual_agents(task_name: str, preset: str) -> tuple[str, ...]:
    """The agents that a preset compares where none are named, also those whose package is not installed."""
    values = {**PRESETS[preset], **task(task_name).presets.get(preset, {})}
    agents: tuple[str, ...] = values.get("agents", Protocol.agents)
    return agents


def protocol(task_name: str, preset: str = "quick", **changes: Any) -> Protocol:
    """The protocol of a preset as the task has it, with ``changes`` to single fields; ``physics`` may be a mapping.

    Where no agents are named, those of this suite's guests that are not installed are left out.

    Raises:
        UnknownNameError: Unknown task, preset, agent, appearance or execution.
        InvalidValueError: A value out of range.
        SetupError: An agent is in a package that is not installed, or all of the preset's are.
    """
    require_known("preset", preset, PRESETS)
    spec = task(task_name)
    own = spec.presets.get(preset, {})
    values: dict[str, Any] = {"config_group": spec.config_group}
    for part in (PRESETS[preset], own, changes):
        if "agents" in part:  # headlines and numbers of seeds are of the agents that stand beside them
            values |= {"headlines": (), "few_seeds": {}}
        values |= part
    if "agents" not in changes:
        usual = usual_agents(task_name, preset)
        values["agents"] = installed_of(usual)[0] or usual
    few = values.pop("few_seeds", {})
    if few and not {"seeds"} & {*own, *changes}:
        values["seeds"] = tuple(range(max(few.values())))
    values["execution"] = spec.execution(values.get("execution"))
    if isinstance(values.get("agents"), list | tuple):  # any other type is refused below
        values["agents"] = tuple(spelled(agent, AGENT_GROUP) for agent in values["agents"])
    values["after"] = tuple(map(canonical, values.get("after", ())))
    values["physics"] = _pairs_of_physics(values.get("physics", ()))
    if values.get("split") is not None:
        values["split"] = split_of(spec.rules, values["split"]).identity
    wanted = Protocol(task=spec.id, preset=preset, **values)
    agents = {*wanted.agents}
    same = wanted.test_appearance == wanted.appearance  # then it says nothing, and belongs in no hash
    wanted = dataclasses.replace(
        wanted,
        test_appearance=None if same else wanted.test_appearance,
        headlines=tuple(pair for pair in wanted.headlines if agents.issuperset(pair)),
        few_seeds=tuple(
            (agent, wanted.seeds[most - 1])
            for agent, most in few.items()
            if agent in agents and most < len(wanted.seeds)
        ),
    )
    code = (*registered_code(wanted.agents), *package_digests(wanted.code_places()))
    wanted = dataclasses.replace(wanted, code=tuple(sorted(code)))
    for agent in wanted.agents:  # a protocol that is only read may be of a package that is not here
        _require_takes(agent, wanted)
        _require_exact_world(agent, wanted)
    _require_learner(wanted)
    require_same_world(wanted.task, wanted.after)
    return wanted


def _pairs_of_physics(given: object) -> tuple[tuple[str, Setting], ...]:
    """The settings of physics as pairs, given as a mapping or as pairs. Raises InvalidValueError for anything else."""
    pairs = given.items() if isinstance(given, Mapping) else given
    items: list[tuple[str, Setting]] | None = [*pairs] if isinstance(pairs, ItemsView | list | tuple) else None
    if items is None or not all(isinstance(each, list | tuple) and len(each) == 2 for each in items):
        raise InvalidValueError(f"physics is {brief(given)}; give a table of settings, such as pad_friction = 0.5.")
    return tuple((name, value) for name, value in items)


def registered_code(agents: Iterable[str]) -> tuple[tuple[str, str], ...]:
    """The digests of agents that were registered as a class or a function, as :attr:`.ProtocolData.code` has them."""
    made_by = {parse_configuration(agent).agent: agent_entry(agent).make for agent in agents}
    return tuple(sorted((name, _digest(make)) for name, make in made_by.items() if isinstance(make, CodeByValue)))


def _digest(make: CodeByValue | str) -> str:
    """The digest of an agent's code: of a class of an installed package, of the class and of that package."""
    return package_code(make) if isinstance(make, str) else make.digest + (make.module and package_code(make.module))


def _require_same_code(agent: str, protocol: Protocol) -> None:
    """Raise ArtefactError if an agent's class, or the package that offers it, is not the one of the protocol."""
    name = parse_configuration(agent).agent
    wanted = dict(protocol.code).get(name)
    make = agent_entry(agent).make
    if isinstance(make, str) and wanted is None:  # this suite's, or of a bench of before packages had digests
        return
    found = _digest(make)
    if wanted not in (found, found[:12]):  # the second of a class, of before packages had digests
        raise ArtefactError(
            f"The code of agent {name} is not that of this bench (digest {wanted}, now {found or None}). Run the bench "
            "command again to begin a new bench, or bring the agent's code back as it was."
        )


def _require_learner(wanted: Protocol) -> None:
    """Raise UnableError for an option of training where no agent of the bench learns."""
    if any(agent_entry(agent).learns for agent in wanted.agents):
        return
    for option in wanted.helps:
        raise UnableError(
            f"No agent of this bench learns ({', '.join(wanted.agents)}), so --{option.replace('_', '-')} changes "
            "nothing; leave it out, or give an agent that learns."
        )


def _require_takes(agent: str, wanted: Protocol) -> None:
    """Raise InvalidValueError for an agent that cannot take the observation, or UnknownNameError."""
    takes = agent_entry(agent).observes
    able = set(wanted.observation.split(",")) <= set(takes) if takes else wanted.shows_frames_alone
    if not able:
        raise InvalidValueError(
            f"Agent {agent!r} takes {', '.join(takes) or '64 x 64 frames'} alone; leave it out, or the observation "
            "as it is by default."
        )


def _require_exact_world(agent: str, wanted: Protocol) -> None:
    """Raise UnableError for an agent that needs the exact world where none is given."""
    if not agent_entry(agent).needs_exact_world:
        return
    if task(wanted.task).sight is not None:
        raise UnableError(
            f"Agent {agent!r} imagines from true macrostates, and frames of {wanted.task} hide a part of them or are "
            "late; leave it out, or the parameters gesture and lag."
        )
    if not agent_entry(agent).learns:  # it is trained neither on earlier tasks nor by a teacher
        return
    if wanted.after:
        raise UnableError(
            f"Agent {agent!r} is given the exact rules of one task, and here another comes before; leave --after out, "
            "or that agent."
        )
    if wanted.feedback:
        raise UnableError(
            f"Agent {agent!r} is given the exact rules of one task, and here a teacher adds to rewards; leave "
            "--feedback out, or that agent."
        )


_OF_WORLDS = {
    "encoder": "their frames show different scenes",
    "preprocessing": "their frames are prepared differently",
    "action_names": "they have different macro-actions",
}
"""Facts in which tasks of one world agree, and the sentence where two tasks do not."""


def require_same_world(name: str, earlier: tuple[str, ...]) -> None:
    """Raise InvalidValueError for an earlier task that is not of the world of task ``name``, or UnknownNameError.

    Tasks are of one world if their frames are preprocessed and encoded alike and their macro-actions have one meaning.
    """
    for other in earlier:
        task_entry(other)
        for fact, words in _OF_WORLDS.items():
            if getattr(task(name), fact) != getattr(task(other), fact):
                raise InvalidValueError(
                    f"{name} cannot come after {other}: {words}, so knowledge of one is of no use in the other. "
                    "Give tasks of one world to --after, such as arrow_puzzle before arrow_puzzle_hard."
                )


def context_of(spec: RunSpec[Protocol]) -> AgentContext:
    """The arguments of the factory of a run's agent."""
    protocol = spec.protocol
    entry = agent_entry(spec.agent)
    _require_same_code(spec.agent, protocol)
    world = task(protocol.task)
    size = (protocol.observation_size, protocol.observation_size, 3)
    shapes = {"state": (sum(map(len, world.macrostate_values)),), "proprio": (PROPRIO_SIZE,)}
    others = protocol.after or protocol.feedback  # tasks of other rules, or rewards of a teacher
    is_only_world = entry.privileged and not (entry.learns and others)
    return AgentContext(
        n_actions=world.n_actions,
        preprocessing=world.preprocessing,
        encoder=spec.encoder if entry.needs_encoder else None,
        seeds=SeedTree(spec.seed).child("agent"),  # the same for every agent: runs of one seed are pairs
        config_group=protocol.config_group,
        hyperparameters=protocol.hyperparameters,
        overrides=own_settings(spec.agent, dict(protocol.overrides)),
        argument=parse_configuration(spec.agent).argument,
        device=protocol.device,
        optimal_policy=optimal_policy_of(world) if entry.privileged else None,
        exact_world=ExactWorld.of(world, protocol.appearance) if is_only_world else None,
        observation={part: shapes.get(part, size) for part in protocol.observation.split(",")},
    )
