"""The observation of agents is a choice of the protocol: shown as named, refused where an agent cannot take it,
reported.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from fake_agents import FakeAgent
from recordings import contents
from small_runs import Inline

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Agent, AgentContext, Observation, Transition
from imagine_bench.protocols.control import Protocol
from imagine_bench.running.bench import bench, plan
from imagine_bench.running.trained import load_trained

_FEW: dict[str, Any] = {"budgets": (3,), "evaluation_episodes": 2, "execution": "kinematic", "recorded_episodes": 1}


class Witness(FakeAgent):
    """Notes its observations."""

    seen: list[Observation]
    contexts: list[AgentContext]

    def act(self, observation: Observation, *, explore: bool) -> int:
        self.seen.append(observation)
        return super().act(observation, explore=explore)

    def observe(self, transition: Transition, *, episode: int) -> None:
        self.seen += [transition.observation, transition.next_observation]


@pytest.fixture
def witness(monkeypatch: pytest.MonkeyPatch) -> Witness:
    """Registered as an agent that takes all but the human's view."""
    agent, usual = Witness(), registry.make_agent
    agent.seen, agent.contexts = [], []

    def make(name: str, context: AgentContext) -> Agent:
        if name != "witness":
            return usual(name, context)
        agent.contexts.append(context)
        return agent

    entry = registry.AgentEntry(make="none:none", needs_encoder=False, observes=("frame", "state", "proprio"))
    monkeypatch.setitem(registry.AGENTS, "witness", entry)
    monkeypatch.setattr(registry, "make_agent", make)
    return agent


@pytest.mark.parametrize(("choice", "size"), [("frame", 64), ("frame", 96), ("state", 64), ("proprio,frame", 64)])
def test_agents_are_shown_what_is_chosen(tmp_path: Path, witness: Witness, choice: str, size: int) -> None:
    shown = {"observation": choice, "observation_size": size}
    wanted, paths = plan("arrow_puzzle", "smoke", agents=("witness",), **_FEW, **shown)
    result = bench(wanted, paths, root=tmp_path, launcher=Inline())
    shapes = {"frame": (size, size, 3), "state": (15,), "proprio": (16,)}
    parts = choice.split(",")
    assert witness.contexts[-1].observation == {part: shapes[part] for part in parts} and len(witness.seen) > 10
    for each in witness.seen:
        assert each.frame.shape == (shapes["frame"] if "frame" in parts else (0, 0, 3))
        assert {name: part.shape for name, part in each.more.items()} == {
            part: shapes[part] for part in parts if part != "frame"
        }
        assert each.macrostate is None and ("state" not in parts or each.more["state"].sum() == 4.0)
    assert "/real/frame" in contents(result.folder / "witness/seed_0/recording.rrd")


def test_choices_in_any_order_are_one_bench() -> None:
    one, other = (
        Protocol(task="arrow_puzzle", preset="quick", observation=each) for each in ("state,frame", "frame,state")
    )
    assert one == other and one.world["observation"] == "frame,state" and "privileged" in one.looks


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"observation_size": 16}, InvalidValueError, "observation_size is 16; give 32 to 256 pixels"),
        (
            {"observation": "human", "agents": ("witness",)},
            InvalidValueError,
            "takes frame, state, proprio alone; leave it out",
        ),
        (
            {"observation": "state", "agents": ("dqn",)},
            InvalidValueError,
            "Agent 'dqn' takes 64 x 64 frames alone; leave",
        ),
    ],
)
@pytest.mark.usefixtures("witness")
def test_what_cannot_be_shown_is_one_sentence(changes: dict[str, Any], error: type[Exception], words: str) -> None:
    with pytest.raises(error) as caught:
        plan("arrow_puzzle", "smoke", **{"agents": ("witness",), **changes})
    assert words in str(caught.value)


@pytest.mark.usefixtures("witness")
def test_a_run_that_saw_something_else_is_not_asked_with_frames(tmp_path: Path) -> None:
    wanted, paths = plan("arrow_puzzle", "smoke", agents=("witness",), observation="state", **_FEW)
    folder = bench(wanted, paths, root=tmp_path, launcher=Inline()).folder / "witness/seed_0"
    with pytest.raises(InvalidValueError, match="is of an agent that sees state at 64 pixels, and it would be asked"):
        load_trained(folder)
