"""The contract's checks: content with our own, and each finds the fault that it is for."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from fake_agents import FakeAgent
from imagine_bench.tasks.arrows.rules import ArrowRules
from imagine_bench.tasks.macro_env import MacroEnv

from imagine_bench import registry
from imagine_bench.errors import ImagineBenchError
from imagine_bench.interfaces import AgentContext, AgentState
from imagine_bench.testing.checks import AGENT_CHECKS, same_state
from imagine_bench.testing.contract import Checks, checks, report


@pytest.mark.parametrize("agent", ["oracle", "dqn"])
def test_our_agents_keep_the_contract(agent: str) -> None:
    assert report(_without_options(agent)) == 0


class _Leaky(ArrowRules):
    def outcomes(self, macrostate: Any, action: int) -> Any:
        return tuple(dataclasses.replace(each, probability=0.9) for each in super().outcomes(macrostate, action))


class _Generous(ArrowRules):
    """Rewards a turn with 1 more than the environment does."""

    def outcomes(self, macrostate: Any, action: int) -> Any:
        return tuple(
            dataclasses.replace(each, reward=each.reward + 1.0) for each in super().outcomes(macrostate, action)
        )


class _Forgetful(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Begins where it likes, and draws noise of its own."""

    noise = np.random.default_rng(0)

    def reset(self, **given: Any) -> Any:
        frame, info = self.env.reset(seed=given.get("seed"))
        return frame ^ self.noise.integers(2, size=frame.shape, dtype=np.uint8), info


class _OneMore(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Has an action that the rules do not know."""

    action_space = gymnasium.spaces.Discrete(7)


def _without_options(agent: str) -> Checks:
    """Checks of an agent without those of protocol options, which tests/contract/test_options.py carries out."""
    return {what: check for what, check in checks(agent=agent).items() if not what.startswith("the option")}


def _failed(capsys: pytest.CaptureFixture[str]) -> Iterator[str]:
    for line in capsys.readouterr().out.splitlines():
        if line.startswith("wrong"):
            yield line.removeprefix("wrong  ")


def test_wrong_tasks_are_found(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    spec = registry.task("arrow_puzzle")

    def check(what: str, **changes: Any) -> str:
        monkeypatch.setattr(registry, "task", lambda name: dataclasses.replace(spec, **changes))
        chosen = {words: check for words, check in checks("arrow_puzzle").items() if what in words}
        assert report(chosen) == len(chosen) == 1
        return next(_failed(capsys))

    leaky, generous = (kind(spec.rules.world) for kind in (_Leaky, _Generous))  # type: ignore[attr-defined]
    assert "sum to 0.9, not 1" in check("distributions", rules=leaky)
    assert "macro-actions end as the rules say: action" in check("as the rules say", rules=generous)
    draw = np.random.default_rng(0)
    assert "frames are int64 of shape" in check(
        "64 x 64", render_macrostates=lambda *_: draw.integers(256, size=(2, 3))
    )
    monkeypatch.setattr(MacroEnv, "set_state", lambda self, state: None)
    assert "put back in the same environment, it goes on otherwise" in check("middle of an episode")
    made = gymnasium.make
    monkeypatch.setattr(gymnasium, "make", lambda *given, **named: _OneMore(made(*given, **named)))
    assert "its action_space is Discrete(7), the rules say Discrete(6)" in check("Gymnasium's checker")
    monkeypatch.setattr(gymnasium, "make", lambda *given, **named: _Forgetful(made(*given, **named)))
    assert "every macrostate is begun in, and told: begun in" in check("is begun in")
    assert "two episodes of seed 0 differ" in check("same seed")


class _Moody(FakeAgent):
    """Counts how often it was asked, and forgets half of it."""

    asked = 0

    def act(self, observation: Any, *, explore: bool) -> int:
        self.asked += 1
        return self.asked % 6

    def state(self) -> AgentState:
        return AgentState(arrays={"asked": np.array(self.asked)}, values={})

    def restore(self, state: AgentState) -> None:
        self.asked = int(state.arrays["asked"]) // 2


def _moody(context: AgentContext) -> _Moody:
    """A factory, as a registry line names it."""
    return _Moody()


@pytest.mark.usefixtures("own_names")
def test_wrong_agents_are_found(capsys: pytest.CaptureFixture[str]) -> None:
    registry.AGENTS["dqn"] = dataclasses.replace(registry.AGENTS["dqn"], make=f"{__name__}:_moody")
    assert report(_without_options("dqn")) == 3
    moody, forgetful, blind = _failed(capsys)
    assert "learned otherwise" in blind
    assert "asked twice with explore=False, it acts otherwise" in moody and "it acts otherwise" in forgetful


class _Sound(FakeAgent):
    """Draws its exploring actions, and counts the transitions that it is shown."""

    def __init__(self, context: AgentContext) -> None:
        super().__init__()
        self.shown = np.zeros(1)

    def act(self, observation: Any, *, explore: bool) -> int:
        return super().act(observation, explore=True) if explore else 0

    def observe(self, transition: Any, *, episode: int) -> None:
        self.shown += 1.0

    def state(self) -> AgentState:
        return AgentState(arrays={"shown": self.shown.copy()}, values={"rng": self.rng.bit_generator.state})

    def restore(self, state: AgentState) -> None:
        self.shown = state.arrays["shown"].copy()
        self.rng.bit_generator.state = state.values["rng"]


class _Wild(_Sound):
    def act(self, observation: Any, *, explore: bool) -> int:
        return 6


class _Counting(_Sound):
    def act(self, observation: Any, *, explore: bool) -> int:
        self.shown += not explore
        return super().act(observation, explore=explore)


class _CountsInValues(_Sound):
    """Keeps a number among the JSON values, not the arrays, and counts in it how often it is asked."""

    asked = 0

    def act(self, observation: Any, *, explore: bool) -> int:
        self.asked += 1
        return super().act(observation, explore=explore)

    def state(self) -> AgentState:
        state = super().state()
        return AgentState(arrays=state.arrays, values={**state.values, "asked": self.asked})


class _SharesValues(_Sound):
    """A list that grows as it learns, and that the state does not copy."""

    def __init__(self, context: AgentContext) -> None:
        super().__init__(context)
        self.rewards: list[float] = []

    def observe(self, transition: Any, *, episode: int) -> None:
        self.rewards.append(transition.reward)

    def state(self) -> AgentState:
        state = super().state()
        return AgentState(arrays=state.arrays, values={**state.values, "rewards": self.rewards})


def test_states_are_compared_as_they_are_kept() -> None:
    """In JSON there are no tuples, no numbers of numpy and no order of names."""

    def state(**values: Any) -> AgentState:
        return AgentState(arrays={"a": np.zeros(2)}, values=values)

    one = state(rate=0.1, pair=[1, 2], counts={"a": 1, "b": 2}, unknown=math.nan)
    same = state(pair=(1, np.int64(2)), rate=np.float64(0.1), counts={"b": 2, "a": 1}, unknown=math.nan)
    assert same_state(one, same)
    assert not same_state(one, state(rate=0.1, pair=[1, 3], counts={"a": 1, "b": 2}, unknown=math.nan))


class _Wordy(_Sound):
    def diagnostics(self) -> Any:
        return {"loss": "small"}


class _Sharing(_Sound):
    def state(self) -> AgentState:
        return dataclasses.replace(super().state(), arrays={"shown": self.shown})


class _Uncertain(_Sound):
    def restore(self, state: AgentState) -> None:
        self.shown = state.arrays["shown"].copy()


class _Forgets(_Sound):
    def restore(self, state: AgentState) -> None:
        self.rng.bit_generator.state = state.values["rng"]


class _KeysOfNumbers(_Sound):
    """A table by side: in the JSON of a checkpoint its keys are texts, so a resumed run has lost it."""

    def __init__(self, context: AgentContext) -> None:
        super().__init__(context)
        self.seen: dict[Any, int] = {}

    def observe(self, transition: Any, *, episode: int) -> None:
        side = transition.action % 2
        self.seen[side] = self.seen.get(side, 0) + 1

    def state(self) -> AgentState:
        state = super().state()
        return AgentState(arrays=state.arrays, values={**state.values, "seen": dict(self.seen)})

    def restore(self, state: AgentState) -> None:
        super().restore(state)
        self.seen = dict(state.values["seen"])


class _ReadsNumbers(_KeysOfNumbers):
    def restore(self, state: AgentState) -> None:
        super().restore(state)
        self.seen = {int(side): count for side, count in self.seen.items()}


class _NumpyValues(_Sound):
    def state(self) -> AgentState:
        state = super().state()
        return AgentState(arrays=state.arrays, values={**state.values, "count": np.int64(1)})


class _Five(_Sound):
    """Acts in a way that three cubes have, and two have not."""

    def act(self, observation: Any, *, explore: bool) -> int:
        return 5


@pytest.mark.usefixtures("own_names")
def test_an_agent_is_checked_in_the_task_that_is_named() -> None:
    make = f"{__name__}:_Five"
    registry.AGENTS["dqn"] = dataclasses.replace(registry.AGENTS["dqn"], make=make, needs_encoder=False)
    found = checks(task="arrows:cubes=2", agent="dqn")
    for what in ("it acts and learns", "taken up", "watched episodes", "the option feedback has"):
        (check,) = (check for words, check in found.items() if words.startswith(what))
        with pytest.raises(ImagineBenchError, match="Action 5 does not exist"):
            check()


def _none(context: AgentContext) -> None:
    """A factory that forgot to return what it made."""


@pytest.mark.usefixtures("own_names")
@pytest.mark.parametrize(
    ("made", "complaint"),
    [
        (_Sound, None),
        (_none, "it is made: Agent dqn has no method act"),
        (_Wild, "greedily without a change: Action 6 does not exist"),
        (_Counting, "acting with explore=False changes its state"),
        (_CountsInValues, "acting with explore=False changes its state"),
        (_SharesValues, "later learning alters a state that it gave before"),
        (_Wordy, "diagnostic 'loss' is 'small'; give a number"),
        (_Sharing, "later learning alters a state that it gave before"),
        (_Uncertain, "it goes on to the same bits: it acts otherwise"),
        (_Forgets, "its later state differs"),
        (_KeysOfNumbers, "its later state differs"),
        (_ReadsNumbers, None),
        (_NumpyValues, "int64 is not JSON serializable"),
    ],
)
def test_each_clause_of_the_contract_finds_its_fault(
    made: Any, complaint: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    make = f"{__name__}:{made.__name__}"
    registry.AGENTS["dqn"] = dataclasses.replace(registry.AGENTS["dqn"], make=make, needs_encoder=False)
    own = {what: check for what, check in checks(agent="dqn").items() if what in AGENT_CHECKS}
    assert bool(report(own)) == (complaint is not None)
    assert complaint is None or complaint in next(_failed(capsys))
