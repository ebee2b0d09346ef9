"""Registry entries; and the agent configurations of a bench: an agent, ``dqn``, or ``dqn:controller.discount=0.99``.

An agent that comes in variants has a registered name for each, such as ``factored:given``; settings follow after a
comma: ``factored:given,planning.depth=1``. A package may offer a prefix, after which an argument follows, such as
``program:FILE.py``. The text is the configuration's name in protocols, tables and files; one agent, regressor or world
model may enter with several settings.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

from imagine_bench.errors import ArtefactError, InvalidValueError, brief, plain, require_known
from imagine_bench.interfaces import OBSERVATIONS
from imagine_bench.registry.by_value import CodeByValue
from imagine_bench.values import Setting

_BETWEEN = re.compile(r",(?=[\w.]+=)")
_LONGEST = 100
ENCODER_KINDS = ("latents", "codes")
"""The outputs of an encoder for a frame: real numbers, or the values of discrete factors."""


@dataclass(frozen=True, kw_only=True)
class TaskEntry:
    """A registered task."""

    spec: str  #: ``"module:attr"`` of its TaskSpec, or of a function from ``options`` to it
    env_id: str  #: Gymnasium id, registered by ``import imagine_bench``
    env: str  #: ``"module:attr"`` of the environment's constructor
    horizon: int | None  #: Macro-actions before truncation; None where its environment truncates by itself
    #: Keyword arguments of both, which say which member of a family it is.
    options: Mapping[str, Setting] = field(default_factory=dict)
    #: ``"module:attr"`` of the frozen dataclass of all such arguments; with it, ``NAME:key=value,...`` is a task, too,
    #: whose TaskSpec has a name and an ``env_id`` of its own.
    world: str = ""
    #: Mean return at which Gymnasium counts it as solved; None where nobody says. Of this suite's tasks it is the
    #: TaskSpec's ``success_threshold`` times the exact optimal mean return, rounded down to a tenth.
    reward_threshold: float | None = None
    #: ``"module:attr"`` of the constructor of its environment of continuous control, which takes ``options`` too and
    #: truncates by itself; empty where it has none.
    motion: str = ""


@dataclass(frozen=True, kw_only=True)
class AgentEntry:
    """A registered agent.

    Raises:
        UnknownNameError: No such kind of encoder, or no such part of an observation.
        InvalidValueError: The relative cost is not above 0, or the exact world is for an agent that is not privileged.
    """

    make: str | CodeByValue  #: ``"module:attr"`` of a function from AgentContext to Agent, or the function itself
    learns: bool = True  #: Whether training changes it; others are only evaluated
    needs_encoder: bool = True  #: Whether it sees the output of an encoder
    encoder_kind: str = "latents"  #: Which of the task's bundled encoders it takes: ``"latents"`` or ``"codes"``
    #: Its settings: ``"module:attr"``, or a module, with ``names()`` and ``resolve(hyperparameters, overrides,
    #: group)``; by default it has none.
    settings: str = ""
    privileged: bool = False  #: Whether it is shown the macrostate and the rules; no fair comparison
    #: Whether it cannot do without :attr:`.AgentContext.exact_world`, which there is where frames hide nothing and,
    #: if it learns, no other task comes before and no teacher adds to rewards; elsewhere a bench refuses it
    needs_exact_world: bool = False
    #: Whether it is a person, or a program elsewhere, whose episodes are kept as a run; nothing here can act for it
    is_player: bool = False
    #: Parts of :data:`.interfaces.OBSERVATIONS` that it can take, images of any size; by default 64 x 64 frames alone
    observes: tuple[str, ...] = ()
    #: Whether it is a :class:`.interfaces.capabilities.ExternalTrainer`, whose run cannot pause.
    external_training_loop: bool = False
    #: CPU time of a run, relative to that of ``dqn``: a guess, by which the longest runs come first
    relative_cost: float = 1.0
    #: Where agents are named ``NAME:ARGUMENT``: ``"module:attr"`` of a function that writes ARGUMENT in one way, see
    #: :func:`imagine_bench.registry.spelled`. Empty: ``NAME`` is the agent.
    argument: str = ""
    title: str = ""  #: For headings, legends and tables; by default the registered name in plain words
    description: str = "A registered agent."  #: One sentence for a reader who knows none of this

    def __post_init__(self) -> None:
        require_known("kind of encoder", self.encoder_kind, ENCODER_KINDS)
        for part in self.observes:
            require_known("part of an observation", part, OBSERVATIONS)
        if not 0.0 < self.relative_cost < math.inf:
            raise InvalidValueError(f"relative_cost is {brief(self.relative_cost)}; give a number above 0.")
        if self.needs_exact_world and not self.privileged:
            raise InvalidValueError("An agent that needs the exact world is privileged; register it so.")


@dataclass(frozen=True, kw_only=True)
class RegressorEntry:
    """A registered regressor."""

    make: str  #: ``"module:attr"`` of a function from RegressorContext to Regressor
    title: str  #: For headings, legends and tables
    description: str  #: One sentence for a reader who knows none of this
    #: Its settings, ``"module:attr"`` of an :class:`imagine_bench.agents.settings.Hyperparameters`, of which the group
    #: of this regressor's name or else the first one counts; by default it has none.
    settings: str = ""


@dataclass(frozen=True, kw_only=True)
class EncoderEntry:
    """An encoder that an installed package offers, for any task."""

    make: str  #: ``"module:attr"`` of a function without arguments to a :class:`.interfaces.FrameEncoder`
    description: str = "An encoder."  #: One sentence for a reader who knows none of this


@dataclass(frozen=True, kw_only=True)
class WorldModelEntry:
    """A registered world model. Raises UnknownNameError: no such kind of encoder."""

    #: ``"module:attr"`` of a function from AgentContext to :class:`.interfaces.model.WorldModel`; that of a privileged
    #: model takes the TaskSpec and the judge's gallery of frames.
    make: str
    title: str  #: For headings, legends and tables
    description: str = "A world model."  #: One sentence for a reader who knows none of this
    encoder_kind: str | None = None  #: Which of the task's encoders it sees through, ``"latents"`` or ``"codes"``
    privileged: bool = False  #: Whether it is given the rules: an end of the scale, no model
    by_default: bool = True  #: Whether it is judged where no models are named; slow ones are not
    settings: str = ""  #: As of :class:`AgentEntry`, read from ``context.overrides``; empty: there are none to give
    argument: str = ""  #: As of :class:`AgentEntry`

    def __post_init__(self) -> None:
        if self.encoder_kind is not None:
            require_known("kind of encoder", self.encoder_kind, ENCODER_KINDS)

    @property
    def label(self) -> str:
        """The title for tables, figures and recordings: it says so of a privileged model."""
        return f"{plain(self.title)} (privileged)" if self.privileged else plain(self.title)


class AgentConfiguration(NamedTuple):
    """An agent and the settings that it alone has in a bench."""

    agent: str  #: registered name, or a registered prefix, a colon and an argument
    settings: Mapping[str, Setting]  #: by dotted name, in the order of names

    def __str__(self) -> str:
        """The one name of this parse_configuration, however its settings were written."""
        if not self.settings:
            return self.agent
        settings = ",".join(f"{name}={_text(value)}" for name, value in self.settings.items())
        return f"{self.agent}{',' if ':' in self.agent else ':'}{settings}"

    @property
    def argument(self) -> str:
        """The text after the colon of the name."""
        return self.agent.partition(":")[2]

    @property
    def words(self) -> str:
        """The settings for a reader, by the last part of their names where that is enough: ``discount 0.99``."""
        short = [name.rpartition(".")[2] for name in self.settings]
        names = self.settings if len(set(short)) < len(short) else short
        return ", ".join(f"{name} {_text(value)}" for name, value in zip(names, self.settings.values(), strict=True))


def parse_configuration(text: str) -> AgentConfiguration:
    """Undo ``str(configuration)``. Raises InvalidValueError: settings that are none, or one that is given twice."""
    agent, colon, rest = text.partition(":")
    words = _BETWEEN.split(rest) if colon else []
    if words and words[0] and "=" not in words[0]:
        agent = f"{agent}:{words.pop(0)}"
    return AgentConfiguration(agent, dict(parse_settings(words, f"Agent {text!r}:")))


def players_named(name: str, description: str) -> dict[str, AgentEntry]:
    """The registry lines of a kind of players, without training episodes and, as ``trained_...``, with some.

    These are prefixes, such as that of ``person:anna``.
    """
    refusal = f"{__name__}:refuse_player"
    told = f"{description} It is told the goal and the names of macro-actions, which no learner is."
    entry = AgentEntry(
        make=refusal, argument=refusal, learns=False, needs_encoder=False, is_player=True, title=name, description=told
    )
    return {name: entry, f"trained_{name}": replace(entry, learns=True, title=f"{name} with training")}


def refuse_player(*given: object) -> str:
    """Raise InvalidValueError: a person, or a program elsewhere, was asked for where an agent acts."""
    del given
    raise InvalidValueError(
        "Nothing here can act for a person or for a program that plays over HTTP. Their episodes are kept by "
        "'imagine-bench play TASK --keep NAME' and 'imagine-bench serve TASK'; leave them out here."
    )


def parse_settings(pairs: Sequence[str], where: str = "--set") -> tuple[tuple[str, Setting], ...]:
    """``name=value`` words to sorted (name, value) pairs; values are read as JSON, and as text where they are none.

    Raises InvalidValueError: a word without ``=``, or a name given twice.
    """
    return tuple(sorted((name, _value(text)) for name, text in _texts(pairs, where).items()))


def parse_options(text: str, kinds: Mapping[str, str], where: str) -> dict[str, Setting]:
    """``name=value,...`` to values by name; those whose kind has a number in it are read as JSON. Raises likewise."""
    texts = _texts(_BETWEEN.split(text), where)
    numbers = {name for name, kind in kinds.items() if "int" in kind or "float" in kind}
    return {name: _value(text) if name in numbers else text for name, text in texts.items()}


def read_mapping(file: Path) -> dict[str, Setting]:
    """A JSON file that holds one mapping. Raises ArtefactError: it does not, or cannot be read."""
    try:
        found = json.loads(file.read_text(), object_pairs_hook=each_once)
    except (OSError, ValueError, RecursionError) as error:
        raise ArtefactError(f"{file} cannot be read ({plain(error)}); give a JSON file of one mapping.") from error
    if not isinstance(found, dict):
        raise ArtefactError(f"{file} holds {brief(found)}; give a JSON file of one mapping.")
    return found


def each_once(pairs: Sequence[tuple[str, Setting]]) -> dict[str, Setting]:
    """The mapping of these pairs. Raises ValueError: a name is given twice, of which JSON would take the last."""
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError(f"one of {', '.join(name for name, _ in pairs)} is given twice")
    return found


def _texts(pairs: Sequence[str], where: str) -> dict[str, str]:
    texts: dict[str, str] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals or not name:
            example = "pad_friction=0.5" if where == "--physics" else "controller.discount=0.9"
            raise InvalidValueError(f"{where} {pair!r} is not of the form name=value, such as {example}.")
        if name in texts:
            raise InvalidValueError(f"{where} names {name!r} twice; give it once.")
        texts[name] = text
    return texts


def file_name(text: str) -> str:
    """A configuration's name as a file or folder may have it on any system; of different ones, different names."""
    safe = re.sub(r"[^\w.,=-]", "-", text, flags=re.ASCII)
    if safe == text.replace(":", "-", 1) and len(safe) <= _LONGEST:
        return safe
    return f"{safe[:_LONGEST]}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def _value(text: str) -> Setting:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text


def _text(value: Setting) -> str:
    return value if isinstance(value, str) and _value(value) == value else json.dumps(value, separators=(",", ":"))


FIRST = 1
TODAY = 2
"""Editions of agents' names: that of files that name none, and that of every new protocol.

A protocol's ``agent_names`` says with which edition it was written. Kept files of edition 1 do not say so; they are
read with today's labels, and written back, hashed and compared with the names that stand in them. Command lines with a
name of edition 1 are refused.
"""
LABEL_OF_OLD_AGENT = {"factored_own": "factored", "factored": "factored:given"}
"""Today's label of each agent that had another name in edition 1 (until 2026-11-28)."""


def label_today(name: str) -> str:
    """Today's label of an agent that edition 1 called ``name``; settings in the name stay."""
    return _renamed(name, LABEL_OF_OLD_AGENT)


def name_in_edition_1(label: str) -> str:
    """The inverse of :func:`label_today`."""
    return _renamed(label, {now: then for then, now in LABEL_OF_OLD_AGENT.items()})


def edition_of(names: Iterable[str], edition: int = FIRST) -> int:
    """The edition that names from a file are of: the first where it says none and holds one that was renamed."""
    return FIRST if edition == FIRST and any(label_today(name) != name for name in names) else TODAY


def agent_label(name: str, protocol: Mapping[str, object]) -> str:
    """Today's label of an agent in a file, beside the protocol, a JSON mapping, that the file was written with."""
    return name if protocol.get("agent_names", FIRST) == TODAY else label_today(name)


def _renamed(name: str, table: Mapping[str, str]) -> str:
    one = parse_configuration(name)
    return str(AgentConfiguration(table.get(one.agent, one.agent), one.settings))
