"""The examples run: in this process on small benches, and, slowly, as the scripts that they are."""

from __future__ import annotations

import importlib
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import gymnasium
import numpy as np
import pytest
from imagine_bench.agents.encoders.encoder import Encoder
from kept import ROOT, facts
from small_runs import Inline, benched

from imagine_bench import registry
from imagine_bench.errors import ArtefactError
from imagine_bench.exact.certificate import certificate
from imagine_bench.judge.models import source_of
from imagine_bench.judge.questions import one_step
from imagine_bench.judge.reading import RenderedFrameIndex
from imagine_bench.judge.truth import expected_reward
from imagine_bench.protocols.control import Protocol
from imagine_bench.running.collect import collect, policy_of
from imagine_bench.seeding import SeedTree
from imagine_bench.sweep.grid import read_grid
from imagine_bench.sweep.run import plan_variant
from imagine_bench.testing.contract import checks, report

EXAMPLES = ROOT / "docs" / "examples"


@pytest.fixture
def example(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, own_names: None) -> Iterator[ModuleType]:
    monkeypatch.syspath_prepend(EXAMPLES)
    monkeypatch.delitem(sys.modules, request.param, raising=False)
    yield importlib.import_module(request.param)
    gymnasium.registry.pop("own/Corridor-v0", None)


def success(folder: Path, task: str, agent: str, *budgets: int) -> list[float]:
    """Success rates of a seed at these budgets, 50 tests each."""
    (run,) = benched(folder, task, agent, budgets=budgets, evaluation_episodes=50).runs
    return [row.success_rate for row in run.checkpoints]


@pytest.mark.parametrize("example", ["own_agent"], indirect=True)
def test_the_agent_keeps_the_contract(example: ModuleType) -> None:
    assert report(checks(agent="own_agent")) == 0


@pytest.mark.slow
@pytest.mark.parametrize("example", ["own_agent"], indirect=True)
def test_the_agent_learns(example: ModuleType, tmp_path: Path) -> None:
    few, many = success(tmp_path, "pick_place", "own_agent", 5, 500)
    assert many > 0.6 > 2 * few


@pytest.mark.parametrize("example", ["patched_vae"], indirect=True)
def test_the_vae_of_patched_images_goes_on_to_the_same_bits(
    example: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = {"FRAMES": 40, "HELD_OUT_FRAMES": 20, "PROBE_STEPS": 5, "FIRST": (2, 4, 5e-4), "BATCH": 6}
    for name, value in small.items():
        monkeypatch.setattr(example, name, value)
    monkeypatch.setattr(example.training, "SAVE_EVERY_S", -1.0)
    begin = ["--start", str(ROOT / example.START), "--steps", "3"]
    example.main([str(tmp_path / "whole.safetensors"), *begin])
    calls: list[int] = []
    loss_of = example.loss_of

    def killed(*arguments: object) -> object:
        calls.append(1)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return loss_of(*arguments)

    monkeypatch.setattr(example, "loss_of", killed)
    with pytest.raises(KeyboardInterrupt):
        example.main([str(tmp_path / "parts.safetensors"), *begin])
    with pytest.raises(ArtefactError, match="another training"):
        example.main([str(tmp_path / "parts.safetensors"), *begin[:2], "--steps", "2"])
    example.main([str(tmp_path / "parts.safetensors"), *begin])
    assert not list(tmp_path.glob("*.unfinished"))
    whole, parts = (Encoder.load(tmp_path / f"{name}.safetensors") for name in ("whole", "parts"))
    weights = parts.network.state_dict()
    assert all(value.equal(weights[name]) for name, value in whole.network.state_dict().items())
    assert len(calls) == 6, "the first three steps are not made again"
    start = Encoder.load(ROOT / example.START).network.state_dict()
    assert not start["encoder.0.weight"].equal(weights["encoder.0.weight"]), "nothing was learned"


@pytest.mark.parametrize("example", ["own_task"], indirect=True)
def test_the_task_keeps_the_contract(example: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert report(checks("corridor")) == 0
    assert capsys.readouterr().out.count("ok  ") == 6  # its state cannot be kept, which is no duty
    (solved,) = success(tmp_path, "corridor", "oracle", 2)
    assert solved >= registry.task("corridor").facts().optimum - 0.05 > 0.9


@pytest.mark.parametrize("example", ["own_world_model"], indirect=True)
def test_the_world_model_keeps_the_contract(example: ModuleType) -> None:
    assert report(checks(model="own_model")) == 0
    spec = registry.task("pick_place")
    index, seeds = RenderedFrameIndex(spec, "clean"), SeedTree(0)
    asked = one_step(spec, index.render)
    truth = np.array([expected_reward(steps[0]) for steps in asked.truth])
    chosen = policy_of("random", spec, 0)
    played, _, _ = collect(spec, chosen, episodes=150, seed=0, execution="kinematic", appearance="clean")
    model = source_of("own_model", spec, index, "clean", seeds).model()
    model.fit(played, seeds.generator())
    imagined = model.imagine(asked.frames, asked.actions, 8, seeds.generator())
    away = np.abs(imagined.rewards[:, :, 0].mean(axis=1) - truth)
    known = imagined.epistemic[:, 0] == 0.0
    assert known.any() and away[known].mean() < 0.5 * away[~known].mean()


@pytest.mark.parametrize("example", ["elsewhere"], indirect=True)
def test_the_agent_that_learns_to_see_acts_in_a_foreign_task(example: ModuleType) -> None:
    """Gymnasium's frozen lake from pixels."""
    found = example.learn("FrozenLake-v1", seed=0, tests=1, budgets=(1, 2))
    assert list(found["success"]) == [1, 2] and found["real_steps"] >= 4


@pytest.mark.slow
@pytest.mark.parametrize("example", ["elsewhere"], indirect=True)
def test_the_agent_that_learns_to_see_solves_what_nobody_here_wrote(example: ModuleType) -> None:
    found = example.learn("FrozenLake-v1", seed=0, tests=5, budgets=(40,))
    assert found["success"] == {40: 1.0} and found["real_steps"] < 1000


def test_what_the_page_says_of_elsewhere_was_kept() -> None:
    page = (ROOT / "docs" / "explanation" / "from_nothing.md").read_text()
    kept = facts("elsewhere/elsewhere.json")["environments"]
    said = re.findall(r"(frozen lake|[\w-]+-5x5): (\d+) % (?:solved )?\((?:random actions: )?(\d+) %\)", page)
    found = []
    for name, each in kept.items():
        short = name.removeprefix("MiniGrid-").removesuffix("-v0").replace("FrozenLake-v1", "frozen lake")
        mean = 100 * np.mean([run["success"]["20"] for run in each["runs"]])
        found.append((short, f"{mean:.0f}", f"{100 * each['blind']:.0f}"))
    assert said == found
    assert len(said) == 4


@pytest.mark.parametrize("example", ["floors"], indirect=True)
def test_what_an_agent_needs_over_the_floor(
    example: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """No gap for a player who knows the way; blind choice is never good enough."""
    assert len(list(example.worlds(3))) == 27
    monkeypatch.setattr(example, "BUDGETS", (4, 8))
    monkeypatch.setattr(example, "worlds", lambda cubes: [("arrow_puzzle_easy", "clean")])
    monkeypatch.setattr(example, "launcher", lambda name, workers: Inline())
    cost = certificate(registry.task("arrow_puzzle_easy")).learning_cost
    assert cost
    for agent, needed, ratio in (("oracle", [0], 0.0), ("random", [None], np.inf)):
        words = f"--agent {agent} --cubes 1 --seeds 1000 --tests 20".split()
        example.main([*words, "--runs", str(tmp_path), "--out", str(tmp_path / "floors.json")])
        (row,) = json.loads((tmp_path / "floors.json").read_text())
        assert (row["transitions"], row["floor"]) == (needed, cost.transitions)
        assert f"{ratio:8.2f} arrow_puzzle_easy clean" in capsys.readouterr().out
    assert example.over_cautious({"transitions": [None, 30, 50], "floor": 25.0}) == 2.0


@pytest.mark.parametrize("example", ["tables"], indirect=True)
def test_how_far_learned_tables_are_from_the_rules(
    example: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Far after one transition, nearer after a quarter as many as the cautious learner needs."""
    cost = certificate(registry.task("arrows:slip=0.1")).learning_cost
    assert cost
    monkeypatch.setattr(example, "MULTIPLES", (1 / cost.transitions, 0.25))
    example.main(["slip=0.1", "--seeds", "1000", "--out", str(tmp_path / "tables.json")])
    world = json.loads((tmp_path / "tables.json").read_text())["worlds"]["slip=0.1"]
    ((first, learned),) = world["total_variation"]
    assert world["transitions"] == [1, round(0.25 * cost.transitions)]
    assert first > 0.4 and first <= 1.0
    assert learned > 0.0 and learned < 0.5 * first


def test_the_study_on_a_page_could_be_run(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "how_to" / "add_agent.md").read_text()
    (text,) = re.findall(r"^```toml\n(question.*?)^```", page, re.MULTILINE | re.DOTALL)
    (tmp_path / "mine.toml").write_text(text)
    study = read_grid(tmp_path / "mine.toml")
    found = [plan_variant(study, "arrow_puzzle", variant)[0] for variant in study.variants]
    assert [(dict(each.overrides), each.appearance_in_words) for each in found if isinstance(each, Protocol)] == [
        ({}, "clean"), ({"controller.discount": 0.9}, "clean"), ({}, "clean, tested at strong"),
    ]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "words", "leaves"),
    [
        ("own_agent", "--budgets 3 --evaluation-episodes 3 --seeds 1 --agents random own_agent", "*/*/*/seed_1/DONE"),
        ("own_task", "--budgets 3 --evaluation-episodes 3 --seeds 1 --agents random oracle", "*/*/*/seed_1/DONE"),
        ("own_world_model", "--seeds 1 --workers 1", "*/own_model-seed1-*.json"),
    ],
)
def test_scripts_run(name: str, words: str, leaves: str, tmp_path: Path) -> None:
    script = [sys.executable, EXAMPLES / f"{name}.py", "--out", str(tmp_path), *words.split()]
    done = subprocess.run(script, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "Report:" in done.stdout
    assert len(list(tmp_path.glob(leaves))) == 2
