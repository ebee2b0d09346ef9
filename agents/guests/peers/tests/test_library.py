"""Agents from Stable-Baselines3: they learn, the same each time, from the starts that every agent of a seed meets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from small_runs import measured, run_observed, small

import imagine_bench  # noqa: F401 - registers the environments
from imagine_bench import registry
from imagine_bench.errors import ArtefactError, SetupError
from imagine_bench.interfaces import AgentState
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
    "sb3.learning_starts": 10, "sb3.batch_size": 8, "sb3.buffer_size": 500, "ppo.n_steps": 8, "ppo.batch_size": 4,
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
    result = do(tmp_path / "run", agent)
    left = [path.name for path in temporary.iterdir() if not path.name.startswith("torchinductor")]  # torch's import
    assert not left
    first, last = result.checkpoints
    assert [row.env_steps for row in result.checkpoints] == [
        result.training_length[:4].sum(),
        result.training_length.sum(),
    ]
    assert result.training_length.shape == (8,) and result.training_length.max() <= 10
    assert (first.test_episodes, last.test_episodes) == (2, 2)
    if "ppo" not in agent:
        assert last.diagnostics["epsilon"] < first.diagnostics["epsilon"] < 1.0
    if agent in ("sb3_ppo_latents", "sb3_ppo_rnd_latents"):  # ten epochs of two batches for each 8 macro-actions
        assert last.diagnostics["gradient_updates"] == 20 * ((last.env_steps - 1) // 8) > 0
    if agent in IMAGINING:
        assert [row.diagnostics["real_transitions"] for row in result.checkpoints] == [first.env_steps, last.env_steps]
        assert last.diagnostics["loss/dynamics"] and "imagination/acceptance_rate" in last.diagnostics


def test_exploration_does_not_depend_on_the_last_budget(tmp_path: Path) -> None:
    """Fewer possible steps than exploration takes, and more: one run gives all budgets."""
    eighty = tuple(sorted({**registry.own_settings(LATENTS, FEW), "sb3.exploration_steps": 80}.items()))
    short = do(tmp_path / "short", budgets=(4,), overrides=eighty)
    longer = do(tmp_path / "longer", overrides=eighty)
    first = short.checkpoints[0]
    same = longer.checkpoints[0]
    assert (first.env_steps, first.diagnostics["epsilon"]) == (same.env_steps, same.diagnostics["epsilon"])


@pytest.mark.parametrize("agent", [LATENTS, *(pytest.param(name, marks=pytest.mark.slow) for name in IMAGINING)])
def test_the_same_seed_learns_the_same_even_after_a_kill(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, agent: str
) -> None:
    whole = do(tmp_path / "whole", agent)

    def killed(*arguments: Any, **names: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(run_folder, "finish", killed)
        do(tmp_path / "run", agent)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(runner, "play_test_episode", killed)
        do(tmp_path / "run", agent)
    assert not (tmp_path / "run/metrics.csv").exists(), "leftovers of the attempt before are not this one's"
    again = do(tmp_path / "run", agent)
    assert measured(whole) == measured(again)
    assert whole.training_length.tolist() == again.training_length.tolist()
    assert whole.training_success.tolist() == again.training_success.tolist()


def test_its_episodes_start_where_all_agents_of_a_seed_start() -> None:
    entry = registry.task_entry("arrow_puzzle")
    with_starts = training_starts(gymnasium.make(entry.env_id, execution="kinematic"), 3)
    plain = gymnasium.make(entry.env_id, execution="kinematic")
    for episode in range(4):
        frame, _ = with_starts.reset(seed=99)  # a loop may ask for another
        expected, _ = plain.reset(seed=episode_seed("training", 3, episode))
        assert np.array_equal(frame, expected)
    with_starts.close()
    plain.close()


def test_latents_are_those_of_our_own_agents() -> None:
    from imagine_bench.agents.encoders.encoder import Encoder
    from imagine_bench.agents.encoders.latent_observation import LatentObservation

    env = gymnasium.make("imagine_bench/ArrowPuzzle-v0", execution="kinematic")
    wrapped = LatentObservation(env, "arrow_puzzle-clean")
    latents, _ = wrapped.reset(seed=5)
    frame, _ = env.reset(seed=5)
    path = encoders.own(registry.task("arrow_puzzle"), "clean")
    assert np.array_equal(latents, Encoder.load(path).encode(frame[None])[0][0].numpy())
    assert latents.shape == wrapped.observation_space.shape and latents.dtype == np.float32
    assert wrapped.observation_space.contains(wrapped.step(0)[0])
    wrapped.close()


class Listener:
    """An algorithm of the library's shape that learns nothing: it compares its rewards with those of the task."""

    def __init__(self, policy: str, world: gymnasium.Env[Any, Any], **keywords: Any) -> None:
        self.world = world

    def set_logger(self, logger: Any) -> None:
        """Log nothing."""

    def learn(self, steps: int, **keywords: Any) -> None:
        """Play three macro-actions in the library's world and in a plain one."""
        plain = gymnasium.make("imagine_bench/ArrowPuzzle-v0", execution="kinematic")
        self.world.reset(seed=5)
        plain.reset(seed=5)
        for action in (0, 1, 2):
            seen = self.world.step(action)[1]
            paid = float(plain.step(action)[1])
            assert seen == pytest.approx(paid * 0.04) and paid, "the library's rewards are the task's, divided by 25"
        plain.close()


def test_the_library_sees_rewards_of_about_one() -> None:
    from imagine_bench_peers.sb3 import LibraryAgent

    agent = LibraryAgent(context_of(spec("sb3_dqn")), f"{__name__}:Listener")
    env = gymnasium.make("imagine_bench/ArrowPuzzle-v0", execution="kinematic")
    agent.train(env, episodes=1, horizon=30, on_episode=lambda solved, length: False)
    env.close()


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

    present = sb3.importlib.import_module

    def missing(name: str) -> Any:
        if name == "sb3_contrib":
            raise ImportError(f"No module named {name!r}")
        return present(name)

    context = context_of(spec("sb3_qrdqn"))
    monkeypatch.setattr(sb3.importlib, "import_module", missing)
    sentence = r"needs the library sb3_contrib.*pip install 'imagine-bench\[peers\]'"
    with pytest.raises(SetupError, match=sentence):
        sb3.make_qrdqn(context)
    with pytest.raises(SetupError, match=sentence):  # before hours of other agents, not after them
        plan("arrow_puzzle", "quick", agents=("dqn", "sb3_qrdqn"))


def spec(agent: str) -> RunSpec:
    path = encoders.own(registry.task("arrow_puzzle"), "clean") if registry.agents()[agent].needs_encoder else None
    return RunSpec(protocol=small(agents=(agent,)), agent=agent, seed=0, encoder=path)
