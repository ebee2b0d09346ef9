"""The best that imagination could give: Algorithm 1 with a perfect model, and with a perfect filter (privileged).

``imagination_exact`` imagines with the rules and with rendered frames in place of a learned model; everything else is
the agent ``imagination``, whose settings it has. ``imagination_exact_filter`` learns the model and keeps those imagined
transitions alone that are right, as an uncertainty that knew every mistake would.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from imagine_bench.agents import snapshot
from imagine_bench.agents.dqn import DQN, epsilon
from imagine_bench.agents.encoders.perception import Perception, load_perception, prepare_torch
from imagine_bench.agents.imagination.agent import ImaginingAgent
from imagine_bench.agents.imagination.rollouts import TERMINAL, Imagination, ImaginedStep
from imagine_bench.agents.imagination.settings import HYPERPARAMETERS, Settings
from imagine_bench.agents.replay import Batch, ImaginedMemory
from torch import Tensor

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import AgentContext, AgentState, ExactWorld, Outcome, Rules, State, Transition
from imagine_bench.seeding import SeedTree

FRAMES_OF_EACH = 8
"""Frames that are rendered of a macrostate."""
_REWARD = 1.0
_RELATIVE = 0.1
"""An imagined reward may be off by so much, or by that share, and is still right."""


class LatentCache:
    """Latents of macrostates: frames of them, rendered when first asked for, as the encoder sees them."""

    def __init__(self, world: ExactWorld, perception: Perception, seeds: SeedTree) -> None:
        self._world = world
        self._perception = perception
        self._seeds = seeds
        self._seen: dict[State, tuple[Tensor, Tensor]] = {}

    def latents(self, states: Sequence[State], generator: torch.Generator) -> Tensor:
        """Of each of N macrostates one frame, and latents drawn from its posterior. Shape (N, Z)."""
        device = generator.device
        chosen = torch.randint(FRAMES_OF_EACH, (len(states),), generator=generator, device=device).tolist()
        posteriors = zip(map(self._posteriors, states), chosen, strict=True)
        seen = [(mu[frame], sigma[frame]) for (mu, sigma), frame in posteriors]
        mu, sigma = (torch.stack(part) for part in zip(*seen, strict=True))
        return torch.addcmul(mu, sigma, torch.empty_like(mu).normal_(generator=generator))

    def _posteriors(self, state: State) -> tuple[Tensor, Tensor]:
        """The same in every run of a seed, whatever was asked for before."""
        if state not in self._seen:
            frames = self._world.render(np.array([state] * FRAMES_OF_EACH), self._seeds.child(*state).generator())
            self._seen[state] = self._perception.encoder.encode(frames)
        return self._seen[state]


class ExactImaginationAgent(DQN):
    """A DQN that also learns from the real outcomes of other macro-actions, from states that it was in."""

    settings: Settings

    def __init__(
        self, perception: Perception, n_actions: int, settings: Settings, seeds: SeedTree, device: torch.device,
        world: ExactWorld,
    ) -> None:  # fmt: skip
        super().__init__(perception, n_actions, settings, seeds, device)
        node = seeds.child("imagination")
        self._rules = world.rules
        self._known: dict[tuple[State, int], Sequence[Outcome]] = {}
        self._latents = LatentCache(world, perception, node.child("gallery"))
        self._draws = torch.Generator(device).manual_seed(node.child("rollouts").integer())
        self.visited: deque[State] = deque(maxlen=settings.memory.real)
        self.imagined = ImaginedMemory(settings.memory.imagined, perception.latent_size, device)

    def store(self, transition: Transition) -> Tensor:
        """As of the DQN; and which macrostate it began in."""
        if transition.observation.macrostate is None:
            raise InvalidValueError(
                "This agent imagines from the true state and was shown none; register it privileged."
            )
        self.visited.append(tuple(transition.observation.macrostate.tolist()))
        return super().store(transition)

    def learn_more(self, z: Tensor, episode: int) -> None:
        """N_I updates on imagined transitions, as of :class:`.ImaginingAgent`, without a model to learn."""
        settings = self.settings.imagination
        if settings.end_episode is not None and episode >= settings.end_episode:
            self.learn_values(self.real, settings.updates_per_step)
        elif episode >= settings.start_episode:
            with self.meters.cpu_time("time/imagination_s"):
                self.imagine_rollouts()
            self.learn_values(self.imagined, settings.updates_per_step)
        self.meters.count("time/imagination_s")

    def _outcomes(self, state: State, action: int) -> Sequence[Outcome]:
        """The outcomes that the rules give, asked once for each pair."""
        if (state, action) not in self._known:
            self._known[state, action] = self._rules.outcomes(state, action)
        return self._known[state, action]

    def imagine_rollouts(self) -> None:
        """I_B rollouts of the rules, I_D steps deep, into the imagined memory."""
        settings = self.settings.imagination
        draws = self._draws
        explores = max(epsilon(self.steps, self.settings.controller), settings.exploration)
        states = self._starts()
        z = self._latents.latents(states, draws)
        for _ in range(settings.depth):
            action = Imagination.act(self.controller, z, explores, draws)
            chances = torch.rand(len(states), generator=draws, device=draws.device).tolist()
            happened = [
                _drawn(self._outcomes(state, each), chance)
                for state, each, chance in zip(states, action.tolist(), chances, strict=True)
            ]
            next_z = self._latents.latents([outcome.macrostate for outcome in happened], draws)
            reward = torch.tensor([outcome.reward for outcome in happened], device=z.device, dtype=z.dtype)
            ended = torch.tensor([outcome.terminated for outcome in happened], device=z.device)
            self.imagined.add(Batch(z, action, reward, next_z, ended.float()))
            states = [outcome.macrostate for outcome in happened if not outcome.terminated]
            z = next_z[~ended]
            if not states:
                break

    def _starts(self) -> list[State]:
        settings = self.settings.imagination
        if settings.start_states == "current":
            return [self.visited[-1]] * settings.breadth
        shape = (settings.breadth,)
        chosen = torch.randint(len(self.visited), shape, generator=self._draws, device=self._draws.device)
        return [self.visited[index] for index in chosen.tolist()]

    def diagnostics(self) -> dict[str, float]:
        """As of the DQN, with how many transitions were imagined so far."""
        return {**super().diagnostics(), "imagined_transitions": float(self.imagined.added)}

    def parts(self) -> dict[str, snapshot.Part]:
        """As of the DQN; and the imagined memory."""
        return {**super().parts(), "imagination/memory": self.imagined, "generator/rollouts": self._draws}

    def state(self) -> AgentState:
        """A snapshot, imagined memory and visited macrostates included."""
        state = super().state()
        state.values.update(imagined_added=self.imagined.added, visited=[list(each) for each in self.visited])
        return state

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot; ArtefactError if it does not fit this agent, and then nothing was changed."""
        super().restore(state)
        self.imagined.added = state.values["imagined_added"]
        self.visited = deque(map(tuple, state.values["visited"]), maxlen=self.settings.memory.real)


class ExactFilterImagination(Imagination):
    """Imagination whose filter knows the rules, and reads imagined latents by the encoder's probe."""

    rules: Rules
    perception: Perception

    def admits(self, z: Tensor, action: Tensor, step: ImaginedStep, gathered: Tensor | float) -> Tensor:
        """Which of N transitions are right, macrostate, reward and end as one outcome of the rules. Shape (N,)."""
        read = self.perception.encoder.read_macrostate
        rows = zip(
            read(z).tolist(), action.tolist(), read(step.next_z).tolist(), step.reward.tolist(),
            (step.p_terminated > TERMINAL).tolist(), strict=True,
        )  # fmt: skip
        right = [
            any(
                (outcome.macrostate, outcome.terminated) == (tuple(after), ended)
                and abs(outcome.reward - reward) <= max(_REWARD, _RELATIVE * abs(outcome.reward))
                for outcome in self.rules.outcomes(tuple(before), chosen)
            )
            for before, chosen, after, reward, ended in rows
        ]
        return super().admits(z, action, step, gathered) & torch.tensor(right, device=z.device)


class ExactFilterAgent(ImaginingAgent):
    """Algorithm 1 with the exact filter; rollouts that it shows are not filtered."""

    imagination: ExactFilterImagination
    imagination_kind = ExactFilterImagination

    def __init__(
        self, perception: Perception, n_actions: int, settings: Settings, seeds: SeedTree, device: torch.device,
        world: ExactWorld,
    ) -> None:  # fmt: skip
        super().__init__(perception, n_actions, settings, seeds, device, filtered=False)
        self.imagination.rules, self.imagination.perception = world.rules, perception


def _drawn(outcomes: Sequence[Outcome], chance: float) -> Outcome:
    """The outcome that a uniform number in [0, 1) chooses."""
    for outcome in outcomes[:-1]:
        chance -= outcome.probability
        if chance < 0.0:
            return outcome
    return outcomes[-1]


def build(
    kind: type[ExactImaginationAgent] | type[ExactFilterAgent], context: AgentContext
) -> ExactImaginationAgent | ExactFilterAgent:
    """A control that knows the world; InvalidValueError where none is given."""
    if context.exact_world is None:
        raise InvalidValueError(
            "This control is given the exact world, which an agent gets that is registered as privileged, in a world "
            "whose frames hide nothing, before which no other task comes, and without a teacher's feedback; here there "
            "is none."
        )
    settings = HYPERPARAMETERS.of(context)
    device = prepare_torch(context.device)
    perception = load_perception(context)
    return kind(perception, context.n_actions, settings, context.seeds, device, context.exact_world)


make = partial(build, ExactImaginationAgent)
"""The ``imagination_exact`` agent."""
make_filter = partial(build, ExactFilterAgent)
"""The ``imagination_exact_filter`` agent."""
