"""A task that a package beside this one offers: plain MJCF, no arm, no encoder; used like one of ours."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from guest_packages import Guests
from imagine_bench.agents.encoders import recipes
from small_runs import benched

from imagine_bench import registry
from imagine_bench.cli import exit_code as main
from imagine_bench.errors import ArtefactError
from imagine_bench.running.trained import learners, load_trained
from imagine_bench.store import encoders
from imagine_bench.store.loading import archive_files


@pytest.fixture
def site(guests: Guests, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The package's folder; encoders are made in seconds and kept in a folder of the test's own."""
    monkeypatch.setenv("IMAGINE_BENCH_CACHE", str(tmp_path / "cache"))
    few = {"frames": 400, "held_out_frames": 50, "steps": 20, "probe_steps": 20}
    for name in ("default", "codes"):
        recipe = dataclasses.replace(recipes.RECIPES["chapter_5"][name], **few)
        monkeypatch.setitem(recipes.RECIPES["chapter_5"], name, recipe)
    return guests.new("task", "lights_out")


@pytest.mark.usefixtures("site")
def test_every_macrostate_has_a_frame_of_its_own() -> None:
    spec = registry.task("lights_out")
    env = gymnasium.make(spec.env_id)
    frames = spec.render_macrostates(np.array(spec.rules.states), "clean", np.random.default_rng(0))
    assert len(np.unique(frames.reshape(16, -1), axis=0)) == 16
    for state, frame in zip(spec.rules.states, frames, strict=True):
        assert np.array_equal(env.reset(options={"macrostate": state})[0], frame)
    env.close()


@pytest.mark.usefixtures("site")
def test_gymnasium_imports_its_module_and_makes_lanes_of_it() -> None:
    lanes = gymnasium.make_vec("lights_out:lights_out/LightsOut-v0", num_envs=2)
    seen, _ = lanes.reset(seed=[4, 5])
    env = gymnasium.make("lights_out/LightsOut-v0")
    assert np.array_equal(seen[1], env.reset(seed=5)[0])
    env.close()
    lanes.close()


@pytest.mark.slow
def test_learners_see_it_through_encoders_that_are_trained_for_it(site: Path, tmp_path: Path) -> None:
    """Which are found again by their digest."""
    few = {"budgets": (5,), "evaluation_episodes": 4, "open_loop_starts": 2, "recorded_episodes": 1}
    folder = benched(tmp_path / "runs", "lights_out", "oracle", "dqn", "factored:given", **few).folder
    assert all((run / "recording.rrd").stat().st_size > 10_000 for run in learners(folder))
    kept = sorted((tmp_path / "cache").rglob("*.safetensors"))
    used = {load_trained(run).spec.encoder for run in learners(folder)}
    assert used == set(kept) and len(used) == 2, "latents for one, codes for the other"
    before = kept[0].read_bytes()
    kept[0].write_bytes(before[:-1] + bytes([before[-1] ^ 1]))
    with pytest.raises(ArtefactError, match="which is not here; give its file with --encoder"):
        [load_trained(run) for run in learners(folder)]


def test_results_are_read_without_the_package(
    guests: Guests, site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = benched(tmp_path, "lights_out", "random", "oracle", budgets=(5,), evaluation_episodes=20)
    solved = {run.agent: run.checkpoints[-1].success_rate for run in result.runs}
    assert solved["oracle"] == 1.0 > solved["random"], "agents without an encoder act in it"
    kept = tmp_path / "kept"
    kept.mkdir()
    for name, content in archive_files(result).items():
        (kept / name).write_text(content)
    guests.offer(site, {})
    for folder in (kept, result.folder):
        assert main(["report", str(folder)]) == 0
        said = capsys.readouterr().out
        assert "Not installed here: task lights_out." in said
        assert re.search(r"^chance level +37$", said, re.MULTILINE), "the bench keeps chance and optimum"
        assert re.search(r"^optimum +100$", said, re.MULTILINE)
        assert "nan" not in (folder / "report" / "index.html").read_text()
    for words in (["report", "--task", "lights_out", "--out", str(tmp_path)], ["bench", "--task", "lights_out"]):
        assert main(words) == 2
        assert "No task 'lights_out'" in capsys.readouterr().err


def test_other_looks_are_another_encoder(site: Path) -> None:
    spec = registry.task("lights_out")
    dark = dataclasses.replace(spec, render_macrostates=lambda *given: spec.render_macrostates(*given) // 2)
    places = [encoders.cached(each, "clean", "codes") for each in (spec, spec, dark)]
    assert places[0] == places[1] != places[2]
