"""Abilities that agents may offer beyond :class:`~.interfaces.Agent`: imagination, predictions, training of their own.

The bench looks which of these an agent has, and uses those that the protocol wants. Shapes: ``D`` imagined
depth, ``A`` actions, ``M`` coordinates of a macrostate. A probe that reads macrostates is for evaluation only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from imagine_bench.arrays import Bools, Floats, Floats32, Frame, Ints, Pixels
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces.observation import Observation

_ROUNDING = 0.001
"""Values of images so far out of range are no fault: they are less than a step of an image of bytes."""


@dataclass(frozen=True, kw_only=True)
class ImaginedRollout:
    """An imagined rollout from one real frame; index d is the imagined result of ``actions[d]``."""

    actions: Ints  #: macro-actions imagined. Shape (D,), int64.
    #: decoded latents as images of the whole view in [0, 1], gray (D, H', W') or RGB (D, H', W', 3)
    frames: Floats32
    #: the decoded encoding of the real frame it started from. Shape (H', W') or (H', W', 3).
    start_frame: Floats32
    rewards: Floats32  #: predicted rewards. Shape (D,).
    p_terminated: Floats32  #: predicted probability that the episode ended there. Shape (D,).
    q_values: Floats32  #: the controller's values in the state *before* each action. Shape (D, A).
    #: epistemic uncertainty of each imagined transition, reduced as the filter does. Shape (D,).
    epistemic: Floats32
    aleatoric: Floats32  #: the same for aleatoric. Shape (D,).
    modal: Floats32  #: the same for modal. Shape (D,).
    #: whether the filter keeps the transition (False from the first rejected one on). Shape (D,).
    accepted: Bools
    macrostates: Ints  #: the macrostate a probe reads from each imagined latent. Shape (D, M).

    def in_range(self) -> ImaginedRollout:
        """This rollout. Raises InvalidValueError if an image has values out of range."""
        for name in ("frames", "start_frame"):
            image = np.asarray(getattr(self, name))
            if not (np.abs(image - 0.5) <= 0.5 + _ROUNDING).all():  # no NaN is either
                found = f"from {image.min():.3g} to {image.max():.3g}"
                raise InvalidValueError(f"imagine() gave {name} {found}; give values from 0 to 1.")
        return self


@runtime_checkable
class EpisodeRememberer(Protocol):
    """An agent that remembers earlier frames of an episode: :meth:`Agent.act` takes its observation in."""

    def begin_episode(self) -> None:
        """Forget the episode so far: the next observation is another's first. No part of :meth:`Agent.state`.

        Called before every episode of training and of tests, and before an agent is asked about a frame on its own.
        """


def begin_episode(agent: object) -> None:
    """Tell an agent, if it remembers, that its next observation is the first of an episode."""
    if isinstance(agent, EpisodeRememberer):
        agent.begin_episode()


@runtime_checkable
class MemoryReader(Protocol):
    """An agent whose memory of an episode can be read; reading changes nothing in the agent."""

    def read_memory(self, frame: Frame, sizes: Sequence[int]) -> Ints:
        """The values that a linear read-out finds in the memory after the frame that was acted on last, or the next.
        Shape (M,).

        It is fitted on frames that the agent learned from: the value of each coordinate of the macrostate that a probe
        saw last, of so many values; -1 of one never seen. No agent acts on it.
        """


@dataclass(frozen=True, slots=True)
class Perceived:
    """The perception of an agent at some time of its training."""

    episodes: int  #: training episodes that had begun
    sizes: tuple[int, ...]  #: numbers of values of the factors that it told apart
    picture: Pixels  #: for people. Shape (H, W, 3).


@runtime_checkable
class SeeingLearner(Protocol):
    """An agent that learned to see while it acted, and can show how."""

    def perceived(self) -> Iterable[Perceived]:
        """Its perception whenever that changed in training, in order; nothing changes in the agent."""


@runtime_checkable
class ValueReader(Protocol):
    """An agent that has action values."""

    def q_values(self, observation: Observation) -> Floats32:
        """Values of every macro-action. Shape (A,)."""


@runtime_checkable
class NoveltyReader(Protocol):
    """An agent that can say how much of each macro-action it does not know; its curiosity goes by this."""

    def novelty(self, observation: Observation, rng: np.random.Generator) -> Floats32 | None:
        """How unknown every macro-action is, in [0, 1] by the agent's own measure; None where it has none. Shape (A,).

        ``rng`` draws weight samples; nothing changes in the agent.
        """


@runtime_checkable
class ModelOnlyTrainer(Protocol):
    """An agent that is trained in its model alone before it is tested."""

    def train_in_model(self) -> bool:
        """Train a little in the model as it is; False, which changes nothing, says that nothing is left to do.

        The bench calls it before each test until it returns False. Its steps are in :meth:`Agent.state`.
        """


OnEpisode = Callable[[bool, int], bool]
"""Told whether a training episode succeeded and its macro-actions; answers whether training goes on."""


@runtime_checkable
class ExternalTrainer(Protocol):
    """An agent whose training loop is its own, as a library's is; an interrupted run of it starts anew."""

    def train(self, env: Any, *, episodes: int, horizon: int, on_episode: OnEpisode) -> None:
        """Train from nothing in the task's ``env``: real ``episodes``, one a reset, of at most ``horizon`` actions.

        ``on_episode`` is to be told of each episode as it ends, before the next macro-action; it may ask the agent to
        act. Training ends when it answers False.
        """


@runtime_checkable
class TransferLearner(Protocol):
    """An agent that can take its knowledge of a world into another task in the same world."""

    def reset_for_new_task(self) -> None:
        """Keep the learned dynamics; the learned rewards and ends of episodes are a prior at most.

        The bench calls it between two tasks of one dynamics; training episodes are counted from 0 again after it.
        """


@dataclass(frozen=True, slots=True)
class Label:
    """The oracle's judgement of an imagined action: the reward it would bring, and whether it would end the episode."""

    reward: float
    terminated: bool


@runtime_checkable
class QueryingAgent(Protocol):
    """An agent that can query an oracle about actions that it only imagines."""

    def query(self, observation: Observation) -> Ints | None:
        """Before it acts: macro-actions (D >= 1,) from the frame seen, whose last is asked about; None asks nothing.

        The scene is imagined to go on through ends of episodes. Nothing changes but the agent's measurements.
        """

    def learn_label(self, observation: Observation, actions: Ints, label: Label | None) -> None:
        """Take in the label of :meth:`query`; None says that it is a matter of chance, so that there is none."""


@runtime_checkable
class Imaginer(Protocol):
    """An agent that can show its imagination; that changes nothing in the agent."""

    def imagine(self, frame: Frame, *, actions: Ints | None, depth: int, rng: np.random.Generator) -> ImaginedRollout:
        """Imagine up to ``depth`` transitions from a real ``frame``; ``rng`` draws components, noise, dropout masks.

        Given ``actions``, (D,) with D <= depth, are never stopped early; None lets the greedy controller choose and
        stops where the model says the episode has ended.
        """


@runtime_checkable
class FrameReader(Protocol):
    """An agent that can say which macrostate it reads in a frame."""

    def read_frames(self, frames: Frame) -> Ints:
        """Macrostates (N, M), as a probe reads them from how frames (N, 64, 64, 3) are encoded; it changes nothing."""


@dataclass(frozen=True, kw_only=True)
class ExpectedOutcomes:
    """The outcomes that a model expects of every macro-action in N frames; the rest to probability 1 ends the
    episode.
    """

    macrostates: Ints  #: the possible next ones, B branches, as a probe reads it. Shape (N, A, B, M).
    p_continues: Floats  #: probability that this follows and the episode goes on. Shape (N, A, B).
    reward: Floats  #: expected reward. Shape (N, A).


@runtime_checkable
class OutcomePredictor(Protocol):
    """An agent whose model can be asked for all of one step; nothing changes in the agent."""

    def predict_outcomes(self, frames: Frame, rng: np.random.Generator) -> ExpectedOutcomes:
        """The outcomes that its model expects from frames (N, 64, 64, 3); ``rng`` draws components, noise, dropout
        masks.
        """


def planned_actions(actions: Ints | None, depth: int, n_actions: int) -> list[int] | None:
    """The question to an :class:`Imaginer`: the first ``depth`` of the actions, or None for its own choice.

    Raises:
        InvalidValueError: No depth to imagine, or actions that are none.
    """
    planned = None if actions is None else [int(action) for action in actions[:depth]]
    if depth < 1 or planned == []:
        raise InvalidValueError(f"Asked to imagine depth {depth} along actions {actions}; give at least one.")
    if planned is not None and not all(0 <= action < n_actions for action in planned):
        raise InvalidValueError(f"Actions {planned} must lie in [0, {n_actions}).")
    return planned
