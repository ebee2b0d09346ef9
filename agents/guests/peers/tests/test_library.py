"""Agents from Stable-Baselines3: they learn, the same each time, from the starts that every agent of a seed meets."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import gymnasium
import numpy as np
import pytest
from agent_states import count_updates
from small_runs import measured, run_observed, small

import imagine_bench  # noqa: F401 - registers the environments
from imagine_bench import registry
from imagine_bench.errors import ArtefactError, SetupError
from imagine_bench.interfaces import AgentState, Observation
from imagine_bench.protocols.control import context_of
from imagine_bench.protocols.data import RunSpec
from imagine_bench.running import runner
from imagine_bench.running.bench import plan
from imagine_bench.running.evaluation import training_starts
from imagine_bench.seeding import episode_seed
from imagine_bench.store import encoders, run_folder
from imagine_bench.store.results import RunResult

pytest.importorskip("stable_baselines3")
pytest.importorskip("sb3_contrib")
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")
LATENTS = "sb3_dqn_latents"
FEW: dict[str, Any] = {
    "sb3.learning_starts": 5, "sb3.batch_size": 8, "sb3.buffer_size": 500, "ppo.n_steps": 8, "ppo.batch_size": 4,
    "imagination.start_episode": 3, "mix.imagined_episodes": 2,
}  # fmt: skip
IMAGINING = ("sb3_dqn_imagined", "sb3_ppo_imagined")


def do(folder: Path, agent: str = LATENTS, seed: int = 0, **changes: Any) -> RunResult:
    own = tuple(sorted(registry.own_settings(agent, FEW).items()))
    few = {"agents": (agent,), "budgets": (4, 8), "evaluation_episodes": 2, "overrides": own}
    path = encoders.own(registry.task("arrow_puzzle"), "clean")
    spec = RunSpec(protocol=small(**{**few, **changes}), agent=agent, seed=seed, encoder=path)
    result = run_observed(spec, folder, lambda progress: None)
    assert result is not None
    return result


@pytest.mark.parametrize(
    "agent",
    [
        "sb3_qrdqn", LATENTS, "sb3_ppo_latents", "sb3_ppo_rnd_latents", IMAGINING[0],
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("sb3_dqn", IMAGINING[1])),
    ],
)  # fmt: skip
def test_its_loop_is_counted_and_tested_and_leaves_no_temporary_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, agent: str
) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    updates = count_updates(monkeypatch)
    result = do(tmp_path / "run", agent)
    left = [path.name for path in temporary.iterdir() if not path.name.startswith("torchinductor")]  # torch's import
    assert not left
    first, last = result.checkpoints
    assert [first.env_steps, last.env_steps] == [result.training_length[:4].sum(), result.training_length.sum()]
    assert result.training_length.shape == (8,) and result.training_length.max() <= 10
    assert (first.test_episodes, last.test_episodes) == (2, 2)
    if "ppo" not in agent:
        assert last.diagnostics["epsilon"] < first.diagnostics["epsilon"] < 1.0
    if agent in ("sb3_ppo_latents", "sb3_ppo_rnd_latents"):  # ten epochs of two batches for each 8 macro-actions
        assert last.diagnostics["gradient_updates"] == 20 * ((last.env_steps - 1) // 8) > 0
    if "rnd" not in agent:  # whose network of novelty is trained beside it
        assert last.diagnostics["gradient_updates"] == len(updates) > 0
    if agent in IMAGINING:
        assert [row.diagnostics["real_transitions"] for row in result.checkpoints] == [first.env_steps, last.env_steps]
        assert last.diagnostics["loss/dynamics"] and "imagination/acceptance_rate" in last.diagnostics


def test_it_learns_from_whatever_the_protocol_shows(tmp_path: Path) -> None:
    result = do(tmp_path / "run", "sb3_dqn", observation="proprio,state")
    assert result.checkpoints[-1].diagnostics["gradient_updates"] > 0


@pytest.mark.parametrize("explore", [False, True])
def test_it_acts_greedily_unless_it_explores(explore: bool) -> None:
    from imagine_bench_peers.sb3 import LibraryAgent

    agent = object.__new__(LibraryAgent)
    agent._encoder = None
    agent._model = mock.Mock(**{"predict.return_value": (np.int64(2), None)})
    assert agent.act(Observation(frame=np.zeros((64, 64, 3), np.uint8)), explore=explore) == 2
    assert agent._model.predict.call_args.kwargs == {"deterministic": not explore}


def test_exploration_does_not_depend_on_the_last_budget(tmp_path: Path) -> None:
    """Fewer possible steps than exploration takes, and more: one run gives all budgets."""
    eighty = tuple(sorted({**registry.own_settings(LATENTS, FEW), "sb3.exploration_steps": 80}.items()))
    runs = [do(tmp_path / str(budgets), budgets=budgets, overrides=eighty) for budgets in ((4,), (4, 8))]
    short, same = (run.checkpoints[0] for run in runs)
    assert (short.env_steps, short.diagnostics["epsilon"]) == (same.env_steps, same.diagnostics["epsilon"])


@pytest.mark.parametrize("agent", [LATENTS, *(pytest.param(name, marks=pytest.mark.slow) for name in IMAGINING)])
def test_the_same_seed_learns_the_same_even_after_a_kill(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, agent: str
) -> None:
    whole = do(tmp_path / "whole", agent)

    for where, name in ((run_folder, "finish"), (runner, "play_test_episode")):
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(where, name, mock.Mock(side_effect=KeyboardInterrupt))
            do(tmp_path / "run", agent)
    assert not (tmp_path / "run/metrics.csv").exists(), "leftovers of the attempt before are not this one's"
    again = do(tmp_path / "run", agent)
    assert measured(whole) == measured(again)
    for column in ("training_length", "training_success"):
        np.testing.assert_array_equal(getattr(whole, column), getattr(again, column))


@pytest.fixture
def world() -> Iterator[gymnasium.Env[Any, Any]]:
    with closing(gymnasium.make("imagine_bench/ArrowPuzzle-v0", execution="kinematic")) as env:
        yield env


def test_its_episodes_start_where_all_agents_of_a_seed_start(world: gymnasium.Env[Any, Any]) -> None:
    with_starts = training_starts(gymnasium.make("imagine_bench/ArrowPuzzle-v0", execution="kinematic"), 3)
    for episode in range(4):
        frame, _ = with_starts.reset(seed=99)  # a loop may ask for another
        expected, _ = world.reset(seed=episode_seed("training", 3, episode))
        assert np.array_equal(frame, expected)
    with_starts.close()


def test_latents_are_those_of_our_own_agents(world: gymnasium.Env[Any, Any]) -> None:
    from imagine_bench.agents.encoders.encoder import Encoder
    from imagine_bench.agents.encoders.latent_observation import LatentObservation

    frame, _ = world.reset(seed=5)
    wrapped = LatentObservation(world, "arrow_puzzle-clean")
    latents, _ = wrapped.reset(seed=5)
    path = encoders.own(registry.task("arrow_puzzle"), "clean")
    assert np.array_equal(latents, Encoder.load(path).encode(frame[None])[0][0].numpy())
    assert wrapped.observation_space.contains(latents) and wrapped.observation_space.contains(wrapped.step(0)[0])


LISTENER = mock.MagicMock()
"""An algorithm of the library's shape that learns nothing."""


def test_the_library_sees_rewards_of_about_one(world: gymnasium.Env[Any, Any]) -> None:
    from imagine_bench_peers.sb3 import LibraryAgent

    agent = LibraryAgent(context_of(spec("sb3_dqn")), f"{__name__}:LISTENER")
    agent.train(world, episodes=1, horizon=30, on_episode=lambda solved, length: False)
    given = LISTENER.call_args.args[1]
    seen: list[float] = []
    paid: list[float] = []
    for env, rewards in ((given, seen), (world, paid)):
        env.reset(seed=5)
        rewards.extend(float(env.step(action)[1]) for action in (0, 1, 2))
    assert all(paid) and seen == pytest.approx([0.04 * reward for reward in paid]), "the task's, divided by 25"


@pytest.mark.parametrize(("agent", "most"), [("sb3_dqn", 10), ("sb3_dqn_imagined", 10 + 4 * 3)])
def test_a_loop_makes_as_many_steps_as_its_episodes_may_have(
    agent: str, most: int, world: gymnasium.Env[Any, Any]
) -> None:
    """Four imagined episodes of at most three steps follow each real one; each seed of a run is one of the library."""
    from imagine_bench_peers.sb3 import ImaginingLibraryAgent, LibraryAgent

    kind: Any = ImaginingLibraryAgent if agent in IMAGINING else LibraryAgent
    seeds = set()
    for seed in (0, 1):
        kind(context_of(replace(spec(agent), seed=seed)), f"{__name__}:LISTENER").train(
            world, episodes=100, horizon=10, on_episode=lambda solved, length: False
        )
        seeds.add(LISTENER.call_args.kwargs["seed"])
        assert LISTENER.return_value.learn.call_args.args == (100 * most,)
        assert LISTENER.call_args.kwargs["exploration_fraction"] * 100 * most == pytest.approx(600)
    assert len(seeds) == 2


@pytest.mark.parametrize("agent", ["sb3_dqn", "sb3_qrdqn", LATENTS, "sb3_ppo_latents", *IMAGINING])
def test_an_agent_has_the_settings_that_its_entry_names(agent: str) -> None:
    """A bench writes those of the entry into its protocol; on frames they are others than on latents."""
    context = context_of(spec(agent))
    named = registry.settings(agent, context.hyperparameters, context.overrides, context.config_group)
    assert registry.make_agent(agent, context).settings == named


def test_it_is_never_taken_up_again_half_way() -> None:
    agent = registry.make_agent("sb3_dqn", context_of(spec("sb3_dqn")))
    with pytest.raises(ArtefactError, match="cannot be taken up again; run its bench anew"):
        agent.restore(AgentState(arrays={}, values={}))


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    from imagine_bench_peers import sb3

    context = context_of(spec("sb3_qrdqn"))
    monkeypatch.setitem(sys.modules, "sb3_contrib", None)
    sentence = r"needs the library sb3_contrib.*pip install 'imagine-bench\[peers\]'"
    with pytest.raises(SetupError, match=sentence):
        sb3.make_qrdqn(context)
    with pytest.raises(SetupError, match=sentence):  # before hours of other agents, not after them
        plan("arrow_puzzle", "quick", agents=("dqn", "sb3_qrdqn"))


def spec(agent: str) -> RunSpec:
    path = encoders.own(registry.task("arrow_puzzle"), "clean") if registry.agents()[agent].needs_encoder else None
    return RunSpec(protocol=small(agents=(agent,)), agent=agent, seed=0, encoder=path)


_MADE = """
import sys
from imagine_bench import registry
from imagine_bench.protocols.control import context_of, protocol
from imagine_bench.protocols.data import RunSpec
of_run = protocol("arrow_puzzle", "smoke", agents=("sb3_dqn",))
registry.make_agent("sb3_dqn", context_of(RunSpec(protocol=of_run, agent="sb3_dqn", seed=0)))
print("torch._dynamo" in sys.modules)
"""


def test_cpu_seconds_of_training_are_without_imports() -> None:
    """The first optimiser of a process imports 800 modules: other runs of the same process would cost a second less."""
    made = subprocess.run([sys.executable, "-c", _MADE], check=True, capture_output=True, text=True)
    assert made.stdout.splitlines()[-1] == "True"
