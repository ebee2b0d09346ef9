"""The agents that learn nothing."""

from __future__ import annotations

import numpy as np
import pytest
from imagine_bench.agents.baselines import make_oracle, make_random

from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.interfaces import AgentContext, AgentState, Observation
from imagine_bench.seeding import SeedTree

FRAME = np.zeros((64, 64, 3), dtype=np.uint8)


def context(seed: int = 0, **changes: object) -> AgentContext:
    values = {"n_actions": 6, "preprocessing": "gray_strips", "encoder": None, "seeds": SeedTree(seed)}
    return AgentContext(**(values | changes))


def actions(agent: object, count: int) -> list[int]:
    return [agent.act(Observation(frame=FRAME), explore=False) for _ in range(count)]  # type: ignore[attr-defined]


def test_random_is_uniform_seeded_and_resumable() -> None:
    agent = make_random(context())
    drawn = actions(agent, 6000)
    counts = np.bincount(drawn, minlength=6)
    assert ((counts - 1000) ** 2 / 1000).sum() < 20.5  # chi-square, 5 degrees of freedom, p = 0.001
    assert actions(make_random(context()), 50) == drawn[:50]
    assert actions(make_random(context(1)), 50) != drawn[:50]
    state = agent.state()
    onward = actions(agent, 20)
    other = make_random(context(7))
    other.restore(state)
    assert actions(other, 20) == onward


def test_what_an_agent_cannot_do_is_said() -> None:
    with pytest.raises(InvalidValueError, match="needs the rules' optimal policy"):
        make_oracle(context())
    with pytest.raises(InvalidValueError, match="was shown no macrostate"):
        actions(make_oracle(context(optimal_policy=lambda: lambda *_: 0)), 1)
    foreign = AgentState(arrays={"controller/value": np.zeros(3)}, values={})
    with pytest.raises(ArtefactError, match="'controller/value'; it is of another agent"):
        make_random(context()).restore(foreign)
