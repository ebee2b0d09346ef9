"""What a run is, and how far it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Literal, TypeVar

from imagine_bench import registry
from imagine_bench.exact.beliefs import optimal_policy_of
from imagine_bench.interfaces import PROPRIO_SIZE, AgentContext, ExactWorld, TaskSpec
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.data import ProtocolData
from imagine_bench.seeding import SeedTree

P_co = TypeVar("P_co", bound=ProtocolData, covariant=True)
Phase = Literal["training", "training in the model", "testing", "imagining", "recording", "done", "failed"]


@dataclass(frozen=True, kw_only=True)
class RunSpec(Generic[P_co]):
    """What one run is."""

    protocol: P_co  #: The comparison it belongs to
    agent: str  #: Registered agent or regressor
    seed: int  #: One of the protocol's seeds
    encoder: Path | None = None  #: The encoder artefact, or None if the agent needs none
    dataset: Path | None = None  #: The folder of the dataset that comes first, or None
    until: int | None = None  #: Budget after which it pauses, or None to the end
    checkpoint_every_s: float = 20.0  #: Seconds of work that a kill may cost
    cores: int = 1  #: How many it may use; they change no result

    @property
    def work(self) -> int:
        """Parts of work to do, of whatever the protocol counts."""
        return self.protocol.work(self.agent, self.until)

    def context(self: RunSpec[Protocol]) -> AgentContext:
        """What the run's agent is built from."""
        protocol, entry = self.protocol, registry.agent_entry(self.agent)
        task = registry.task(protocol.task)
        return AgentContext(
            n_actions=task.n_actions,
            preprocessing=task.preprocessing,
            encoder=self.encoder if entry.needs_encoder else None,
            seeds=SeedTree(self.seed).child("agent"),  # the same for every agent: runs of one seed are pairs
            config_group=protocol.config_group,
            hyperparameters=protocol.hyperparameters,
            overrides=registry.own_settings(self.agent, dict(protocol.overrides)),
            device=protocol.device,
            optimal_policy=optimal_policy_of(task) if entry.privileged else None,
            exact_world=ExactWorld.of(task, protocol.appearance) if entry.privileged else None,
            observation={part: _shape(part, task, protocol) for part in protocol.observation.split(",")},
        )


def _shape(part: str, task: TaskSpec, protocol: Protocol) -> tuple[int, ...]:
    vectors = {"state": sum(map(len, task.macrostate_values)), "proprio": PROPRIO_SIZE}
    return (vectors[part],) if part in vectors else (protocol.observation_size, protocol.observation_size, 3)


@dataclass(frozen=True, kw_only=True)
class Progress:
    """How far a run is."""

    agent: str  #: Registered agent
    seed: int  #: The run's seed
    bench: str = ""  #: Hash of the run's protocol
    phase: Phase  #: What it is doing
    done: int  #: Episodes played, for training and for tests
    work: int  #: Episodes to play
    episode: int = 0  #: Training episodes done
    #: Share of successes among recent training episodes, or in the running test; None before the first.
    success: float | None = None
    #: What a run without episodes is doing, or why one failed, in words; None where episodes say it.
    detail: str | None = None


OnProgress = Callable[[Progress], None]
