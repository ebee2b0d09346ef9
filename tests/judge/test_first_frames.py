"""Whatever the judge asks an agent about a frame, the agent is told first that an episode begins there."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import bench_fakes
import numpy as np
import pytest
from judged import labelled
from numpy.typing import NDArray
from small_runs import context

from imagine_bench.interfaces import Frame, Observation
from imagine_bench.interfaces.capabilities import ExpectedOutcomes, ImaginedRollout
from imagine_bench.judge.causes import beliefs, misread
from imagine_bench.judge.models import AgentModel
from imagine_bench.judge.open_loop import (
    EXAMPLES,
    SAMPLED_ROLLOUTS,
    examples,
    imagine_sampled_rollouts,
    open_loop,
    surviving_actions,
)
from imagine_bench.judge.plans import carry_out, make_env
from imagine_bench.protocols.control import protocol
from imagine_bench.protocols.data import RunSpec
from imagine_bench.running.trained import Trained
from imagine_bench.seeding import SeedTree

SPEC = labelled("pick_place:gesture=first")
RNG = np.random.default_rng(0)
STATES = np.array(SPEC.rules.states)
FRAMES = SPEC.render_macrostates(STATES, "clean", RNG)


class Rememberer(bench_fakes.RulesImaginer):
    """Counts its answers; a frame that does not begin an episode is refused."""

    def __init__(self) -> None:
        super().__init__(context())
        self.answers = 0
        self.begins = False

    def begin_episode(self) -> None:
        self.begins = True

    def answer(self) -> None:
        assert self.begins, "it is asked in the middle of an episode"
        self.answers += 1

    def act(self, observation: Observation, *, explore: bool) -> int:
        self.answer()
        self.begins = False
        return 0

    def read_frames(self, frames: Frame) -> NDArray[np.int64]:
        self.answer()
        return STATES[: len(frames)]

    def predict_outcomes(self, frames: Frame, rng: np.random.Generator) -> ExpectedOutcomes:
        self.answer()
        nothing = np.zeros((len(frames), SPEC.n_actions))
        where = np.repeat(STATES[: len(frames), None, None], SPEC.n_actions, axis=1)
        return ExpectedOutcomes(macrostates=where, p_continues=nothing[..., None], reward=nothing)

    def imagine(
        self, frame: Frame, *, actions: NDArray[np.int64] | None, depth: int, rng: np.random.Generator
    ) -> ImaginedRollout:
        self.answer()
        return super().imagine(frame, actions=actions, depth=depth, rng=rng)


def plan(agent: Rememberer) -> None:
    """Imagine a plan and carry it out."""
    run = RunSpec(protocol=protocol("pick_place", "smoke", seeds=(0,)), agent="imagination", seed=0)
    trained = Trained(agent=agent, spec=run, task=SPEC, episodes=7, folder=Path("somewhere"))
    with closing(make_env(trained, "kinematic")) as env:
        carry_out(env, trained, 0)


def in_open_loop(agent: Rememberer) -> None:
    asked = surviving_actions(SPEC, starts=2, depth=1, appearance="clean")
    assert asked is not None
    open_loop(agent, asked, SeedTree(0))


ASKED: dict[str, tuple[Callable[[Rememberer], object], int]] = {
    "read frames": (lambda agent: misread(agent, FRAMES[:3], STATES[:3]), 1),
    "policy and model": (
        lambda agent: beliefs(agent, SPEC.rules, FRAMES, RNG, privileged=False),
        sum(not SPEC.rules.is_terminal(state) for state in SPEC.rules.states) + 1,
    ),
    "open loop": (in_open_loop, 2),
    "examples": (lambda agent: examples(agent, SPEC, appearance="clean", seeds=SeedTree(0)), EXAMPLES),
    "samples": (
        lambda agent: imagine_sampled_rollouts(agent, SPEC, appearance="clean", seeds=SeedTree(0)),
        SAMPLED_ROLLOUTS,
    ),
    "world model": (lambda agent: AgentModel(agent).imagine(FRAMES[:2, None], np.zeros((2, 1), np.int64), 3, RNG), 6),
    "plan": (plan, 1),
}
"""Every question, and how many answers it takes."""


@pytest.mark.parametrize("name", ASKED)
def test_an_agent_is_told_that_an_episode_begins_before_it_is_asked(name: str) -> None:
    ask, answers = ASKED[name]
    agent = Rememberer()
    for _ in range(2):
        agent.begin_episode()
        agent.act(Observation(frame=FRAMES[0]), explore=False)  # of an earlier episode
        agent.answers = 0
        ask(agent)
        assert agent.answers == answers
