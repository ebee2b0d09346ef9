"""A trained agent is taken up as its run left it, through the encoder that it saw through, or a sentence says why."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from bench_fakes import TableAgent
from fake_results import bench_result, rewritten
from small_runs import do, final_arrays, small

from imagine_bench import registry
from imagine_bench.errors import ArtefactError
from imagine_bench.interfaces import AgentState
from imagine_bench.judge.plans import make_plans
from imagine_bench.protocols.control import protocol
from imagine_bench.protocols.data import RunSpec
from imagine_bench.running.runner import run
from imagine_bench.running.trained import best_run, learners, load_trained
from imagine_bench.store import encoders, run_folder
from imagine_bench.store.bench_folder import BenchStore
from imagine_bench.store.files import sealed, write_json

TASK = registry.task("arrow_puzzle")


def test_a_real_agent_is_taken_up_as_its_run_left_it(tmp_path: Path) -> None:
    tiny = (("imagination.weight_samples", 3), ("model.batch_size", 8), ("model.dynamics_hidden", (16,)))
    encoder = encoders.own(TASK, "clean")
    agent = "imagination_uncertainty"
    named = encoders.identity(encoder)
    wanted = small(agents=(agent,), budgets=(2,), evaluation_episodes=1, overrides=tiny, encoder=named)
    spec = RunSpec(protocol=wanted, agent=agent, seed=0, encoder=encoder)
    folder = tmp_path / "run"
    run(spec, folder, lambda progress: None)
    who = load_trained(folder)
    assert who.episodes == 2 and who.task.id == "arrow_puzzle"
    left = final_arrays(folder)
    taken_up = who.agent.state().arrays
    assert set(taken_up) == set(left) and all(np.array_equal(array, taken_up[name]) for name, array in left.items())
    config = run_folder.read_config(folder)
    as_presets_change = {**config, "protocol": dataclasses.replace(wanted, overrides=()).as_dict()}
    write_json(folder / "config.json", sealed(as_presets_change))
    assert load_trained(folder).agent.settings == who.agent.settings, "it has those that it ran with"  # type: ignore[attr-defined]
    write_json(folder / "config.json", sealed(config))
    first, again = (next(make_plans(load_trained(folder), count=1, execution="kinematic")) for _ in range(2))
    assert np.array_equal(first.compared.rollout.q_values, again.compared.rollout.q_values)
    with pytest.raises(ArtefactError, match=r"There is no .*config\.json, a run's configuration; give a run's folder"):
        load_trained(tmp_path)
    with pytest.raises(ArtefactError, match=r"through encoder arrow_puzzle-clean@.*, which arrow_puzzle-mild is not"):
        load_trained(folder, encoder="arrow_puzzle-mild")
    other = dataclasses.replace(spec, encoder=encoders.own(TASK, "mild"))
    with pytest.raises(ArtefactError, match=r"is arrow_puzzle-mild@.*, and this bench is of .*-clean@"):
        run(other, tmp_path / "another node", lambda progress: None)


@pytest.mark.usefixtures("own_names")
def test_learners_are_those_that_learned_and_can_be_taken_up(tmp_path: Path) -> None:
    registry.AGENTS["of_a_library"] = dataclasses.replace(registry.AGENTS["table"], external_training_loop=True)
    wanted = small(agents=("table", "imaginer", "of_a_library", "random"))
    store = BenchStore(tmp_path, wanted)
    write_json(tmp_path / "protocol.json", wanted.as_dict())
    nothing = AgentState(arrays={}, values={})
    for agent, episode in (("table", 1), ("imaginer", 0), ("of_a_library", 5), ("random", 5)):
        found = run_folder.Snapshot(episode=episode, agent=nothing, arrays={}, values={})
        run_folder.save_snapshot(store.run_folder(agent, 0) / run_folder.CHECKPOINTS, found)
    assert learners(tmp_path) == (store.run_folder("table", 0),), "imaginer is still at the tasks before"


class ModelOnly(TableAgent):
    """Trains in its model in three parts, anew each time that it is made."""

    trained: list[ModelOnly] = []  # noqa: RUF012 - how a test finds them

    def train_in_model(self) -> bool:
        self.trained.append(self)
        return self.trained.count(self) < 3


@pytest.mark.usefixtures("own_names")
def test_training_in_the_model_comes_before_an_analysis(tmp_path: Path) -> None:
    registry.AGENTS["model_only"] = dataclasses.replace(registry.AGENTS["table"], make=f"{__name__}:ModelOnly")
    do(tmp_path, "model_only", agents=("model_only",), budgets=(2,), evaluation_episodes=1)
    loaded = load_trained(tmp_path).agent
    assert ModelOnly.trained[3:] == [loaded] * 3


def test_one_encoder_file_is_enough_for_agents_of_two_kinds(tmp_path: Path) -> None:
    own = tmp_path / "own.safetensors"
    shutil.copy(encoders.own(TASK, "clean"), own)
    codes = encoders.own(TASK, "clean", kind="codes")
    names = {"encoder": encoders.identity(own), "codes": encoders.identity(codes)}
    wanted = protocol("arrow_puzzle", "smoke", agents=("dqn", "factored:given"), **names)
    config = {"format": run_folder.FORMAT, "protocol": wanted.as_dict(), "seed": 0, "settings": {}}
    for agent in ("factored:given", "dqn"):
        (tmp_path / "config.json").write_text(json.dumps(sealed({**config, "agent": agent})))
        with pytest.raises(ArtefactError, match="has no checkpoint"):  # the encoder was found
            load_trained(tmp_path, encoder=str(own))
    with pytest.raises(ArtefactError, match=r"own@\w+, which is not here; give its file with --encoder"):
        load_trained(tmp_path)
    with pytest.raises(ArtefactError, match=r"own@\w+, which arrow_puzzle-mild is not"):
        load_trained(tmp_path, encoder="arrow_puzzle-mild")


def test_of_runs_that_end_alike_the_earlier_one_is_taken(tmp_path: Path) -> None:
    wanted = protocol("arrow_puzzle", agents=("imagination",), seeds=(0, 1), budgets=(1, 2, 3))
    result = bench_result(tmp_path, protocol=wanted)
    for counts, best in ((((9, 9, 10), (1, 10, 10)), 1), (((1, 1, 10), (9, 9, 9)), 0), (((5, 5, 5), (5, 5, 5)), 0)):
        solved = iter(sum(counts, ()))
        changed = rewritten(result, lambda _, row, solved=solved: dataclasses.replace(row, successes=next(solved)))
        assert best_run(changed).seed == best
