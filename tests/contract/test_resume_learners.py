"""The real learners, killed in the midst of a run and resumed, end in the bits of an uninterrupted one."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from agent_states import count_updates
from numpy.typing import NDArray
from small_runs import KilledError, final_state, measured, run_observed, small
from whole_outputs import Expected, rounded

from imagine_bench import registry
from imagine_bench.errors import UnknownNameError
from imagine_bench.interfaces import AgentState, Observation, capabilities
from imagine_bench.protocols.data import RunSpec
from imagine_bench.store import encoders
from imagine_bench.store.results import RunResult
from imagine_bench.testing.checks import checked_agent, same_state

LEARNERS = [
    name
    for name, entry in registry.agents().items()
    if entry.learns and not entry.external_training_loop and entry.make.startswith("imagine_bench")
]
"""All of the suite but those that a library trains, which begin anew; fakes of other tests are registered too."""


def do(folder: Path, agent: str, every_s: float) -> RunResult:
    overrides = {"imagination.model_only_episodes": 3, "imagination.start_episode": 2, "reuse.reset_every": 70}
    own = tuple(registry.own_settings(agent, overrides).items())
    protocol = small(agents=(agent,), budgets=(4, 8), evaluation_episodes=2, open_loop_starts=2, overrides=own)
    encoder = encoders.own(registry.task("arrow_puzzle"), "clean", kind=registry.agents()[agent].encoder_kind)
    spec = RunSpec(protocol=protocol, agent=agent, seed=1, encoder=encoder, checkpoint_every_s=every_s)
    return run_observed(spec, folder, lambda progress: None)


def mean(array: NDArray[Any]) -> float:
    """Mean magnitude, of texts their number; gradients below 0.01 may be roundings alone, and all are shown so."""
    return max(0.01, float(np.abs(array.astype(np.float64)).mean())) if array.dtype.kind in "fiub" else array.size


def as_text(run: RunResult, state: AgentState) -> str:
    """The actions of a run, and its numbers with so few digits that processors agree."""
    assert run.training is not None
    lines = [f"settings {rounded(dict(run.settings))}", f"training {rounded(run.training.actions)}"]
    for row in run.checkpoints:
        assert row.kept is not None and row.kept.lengths.sum() == len(row.kept.actions)
        said = {name: float(f"{value:.3g}") for name, value in row.diagnostics.items() if not name.startswith("time/")}
        lines += [f"after {row.episodes}: {rounded(row.kept.actions)} {row.successes} solved", f"  {rounded(said)}"]
    for name, array in sorted(state.arrays.items()):
        is_frame = array.dtype == np.uint8  # or the state of a generator
        lines.append(f"  {name} {array.shape}" + ("" if is_frame or not array.size else f": {mean(array):.2g}"))
    return "\n".join(lines)


_DO_LESS = (
    "imagination", "imagination_only", "dqn_more_updates", "q_learning_macrostate", "dyna_q_macrostate",
    "count_table_directed_macrostate", "posterior_sampling_macrostate", "dqn_codes", "imagination_exact_filter",
    "dreamer_v3", "count_table",
)  # fmt: skip
"""Agents of whose class the fast tests kill another, which does more or takes less time."""


EACH = [pytest.param(agent, marks=[pytest.mark.slow] * (agent in _DO_LESS)) for agent in LEARNERS]


@pytest.mark.parametrize("agent", EACH)
def test_copies_and_pickles_of_a_learner_learn_on_by_themselves(agent: str) -> None:
    one = checked_agent(agent, "arrow_puzzle")
    original, restored = one.make(), one.make()
    one.train(original, range(2))
    early = original.state()
    as_it_was = copy.deepcopy(early)
    one.train(restored, range(5, 6))
    restored.restore(early)
    twins = [restored, copy.deepcopy(original), pickle.loads(pickle.dumps(original))]
    *ends, (actions, state) = [(one.train(each, range(2, 4)), each.state()) for each in (*twins, original)]
    for its_actions, its_state in ends:
        assert its_actions == actions and same_state(its_state, state)
    assert same_state(early, as_it_was), "a snapshot does not change while the learner learns on"


Asked = Callable[[Any, list[Observation], np.random.Generator], object]
READINGS: dict[type, Asked] = {
    capabilities.ValueReader: lambda agent, seen, rng: agent.q_values(seen[0]),
    capabilities.NoveltyReader: lambda agent, seen, rng: agent.novelty(seen[0], rng),
    capabilities.MemoryReader: lambda agent, seen, rng: agent.read_memory(seen[0].frame, (4, 4, 4, 3)),
    capabilities.SeeingLearner: lambda agent, seen, rng: list(agent.perceived()),
    capabilities.Imaginer: lambda agent, seen, rng: [
        agent.imagine(seen[0].frame, actions=actions, depth=3, rng=rng) for actions in (None, np.array([0, 4, 1]))
    ],
    capabilities.FrameReader: lambda agent, seen, rng: agent.read_frames(np.stack([each.frame for each in seen])),
    capabilities.OutcomePredictor: lambda agent, seen, rng: agent.predict_outcomes(
        np.stack([each.frame for each in seen[:3]]), rng
    ),
}
"""How a learner is asked, by the capability."""


@pytest.mark.parametrize("agent", EACH)
def test_a_learner_that_is_asked_learns_on_as_one_that_is_not(agent: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """And equal questions with equal generators have equal answers, of each frame by itself.

    It says as many gradient updates and real transitions as there were.
    """
    one = checked_agent(agent, "arrow_puzzle")
    drawing = registry.own_settings(agent, {"model.dropout": 0.3})  # so that its answers are random
    one = one._replace(context=dataclasses.replace(one.context, overrides={**one.context.overrides, **drawing}))
    asked, alone = one.make(), one.make()
    one.train(asked, range(2))
    updates = count_updates(monkeypatch)
    said = {"real_transitions": len(one.train(alone, range(2)))}
    said["gradient_updates"] = len(updates) / (3 if agent.startswith("dreamer") else 1)  # world model, actor, critic
    assert said.items() <= alone.diagnostics().items()
    asked.diagnostics()
    states = np.array(one.spec.rules.start_states[::20])
    frames = one.spec.render_macrostates(states, "clean", np.random.default_rng(0))
    shown = states if one.entry.privileged else [None] * len(states)
    seen = [Observation(frame=frame, macrostate=state) for frame, state in zip(frames, shown, strict=True)]
    capabilities.begin_episode(asked)
    for capability, ask in READINGS.items():
        if isinstance(asked, capability):
            answers = [pickle.dumps(ask(asked, seen, np.random.default_rng(1))) for _ in range(2)]
            assert answers[0] == answers[1], capability
    if isinstance(asked, capabilities.FrameReader):
        assert np.array_equal(asked.read_frames(frames), [asked.read_frames(frame[None])[0] for frame in frames])
    assert same_state(asked.state(), alone.state())
    assert one.train(asked, range(2, 3)) == one.train(alone, range(2, 3))
    assert same_state(asked.state(), alone.state())


@pytest.mark.parametrize("agent", EACH)
def test_a_device_that_there_is_not_is_refused(agent: str) -> None:
    one = checked_agent(agent, "arrow_puzzle")
    without_torch = agent == "elimination" or agent.endswith("_macrostate")
    with contextlib.nullcontext() if without_torch else pytest.raises(UnknownNameError, match="gpu"):
        registry.make_agent(agent, dataclasses.replace(one.context, device="gpu"))


@pytest.mark.parametrize("agent", EACH)
def test_a_killed_learner_ends_in_the_same_bits(
    tmp_path: Path, die_after_saves: Callable[..., None], agent: str, expected: Expected
) -> None:
    """And the uninterrupted one in the actions, diagnostics and magnitudes that are kept."""
    whole = do(tmp_path / "whole", agent, 1e9)
    expected("learners", as_text(whole, final_state(tmp_path / "whole")), section=agent, exactly=False)
    die_after_saves(3, 6, 9)  # training before and after the first test, and within a test
    for _ in range(3):
        with pytest.raises(KilledError):
            do(tmp_path / "run", agent, 0.0)
    resumed = do(tmp_path / "run", agent, 0.0)
    assert measured(whole) == measured(resumed)
    tables = agent in ("factored", "count_table_own", "elimination") or registry.agents()[agent].encoder_kind == "codes"
    assert tables or any(name.startswith("loss/") for name in whole.checkpoints[-1].diagnostics)
    assert same_state(final_state(tmp_path / "whole"), final_state(tmp_path / "run"))
    for one, other in zip(whole.imagined, resumed.imagined, strict=True):
        assert np.array_equal(one.rollout.frames, other.rollout.frames)
