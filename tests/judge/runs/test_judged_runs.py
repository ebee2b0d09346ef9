"""Trained agents are judged by their runs, and what a judgement is of: its folder, world and encoder."""

from __future__ import annotations

import dataclasses
import itertools
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_runs import Inline, do, small

from imagine_bench import registry, statistics
from imagine_bench.data.folder import macrostates_of
from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.interfaces import State
from imagine_bench.judge import judgement, questions
from imagine_bench.judge.judgement import Judgement, data_of, judge, kept, shown
from imagine_bench.judge.models import ModelSource, closed_modules, model_entry, opened, source_of
from imagine_bench.judge.reading import RenderedFrameIndex
from imagine_bench.protocols.control import protocol
from imagine_bench.report.judge import Judged, compared, judged, judgement_page
from imagine_bench.report.page import estimate, number
from imagine_bench.running import bench as benches
from imagine_bench.seeding import SeedTree
from imagine_bench.store import encoders, run_folder
from imagine_bench.store.files import sealed, write_json

pytestmark = pytest.mark.usefixtures("blind")
_LATENTS = "pick_place-mild"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The run of seed 0 of each agent; that of seed 1 lies beside it."""
    wanted = small(budgets=(2,), agents=("table", "imaginer"), seeds=(0, 1))
    result = benches.bench(wanted, {}, root=tmp_path_factory.mktemp("bench"), launcher=Inline())
    return {run.agent: run.folder for run in result.runs if run.seed == 0}


@pytest.fixture
def _few(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Few questions."""
    for name, count in {"STATES": 10, "AFTER_THE_END": 10, "ROLLOUTS": 4, "PAIRS": 4}.items():
        monkeypatch.setattr(questions, name, count)
    judgement.prepare.cache_clear()
    yield
    judgement.prepare.cache_clear()


def _judged(root: Path, *models: str, seeds: tuple[int, ...]) -> tuple[Path, Judgement]:
    one = Judgement(task="arrow_puzzle", models=models, sizes=(20, 40), seeds=seeds, samples=1)
    folder, failed = judge(one, root, workers=1)
    assert failed == []
    return folder, one


@pytest.mark.slow
@pytest.mark.usefixtures("_few")
def test_right_macrostates_beside_black_frames_are_fog(runs: dict[str, Path], tmp_path: Path) -> None:
    """An agent's own reading of its images counts for nothing."""
    run = str(runs["imaginer"])
    folder, one = _judged(tmp_path, run, "copy", seeds=(1000, 1001))
    (cell,) = (cell for cell in kept(folder, one) if cell["model"] == run)
    assert (cell["seed"], cell["transitions"]) == (0, 40), "it learns nothing here: once"
    assert cell["unreadable"] == cell["total_variation"] == cell["after_the_end"] == 1.0
    assert cell["fit_s"] is None
    assert "imaginer, seed 0  " in judgement_page(judged(folder, one)).summary
    folder, other = _judged(tmp_path, "copy", seeds=(1001,))
    assert [shown(folder, each)["copy"]["seed"] for each in (one, other)] == [1000, 1001], "images of the first seed"


@pytest.mark.usefixtures("_few")
def test_the_folder_of_an_agent_stands_for_all_its_runs(runs: dict[str, Path], tmp_path: Path) -> None:
    agent = str(runs["imaginer"].parent)
    folder, one = _judged(tmp_path, agent, seeds=(1000,))
    assert [(cell["model"], cell["seed"]) for cell in kept(folder, one)] == [(agent, 0), (agent, 1)]
    assert not list(folder.glob("data-*")), "nothing is collected for a model that does not learn"
    assert list(shown(folder, one)) == [agent]


def test_a_verdict_says_what_each_model_had_learned_from(runs: dict[str, Path], tmp_path: Path) -> None:
    """A trained agent learned in its bench, and not from the data of the others."""
    run, spec = str(runs["imaginer"]), registry.task("arrow_puzzle")
    said = {
        models: Judged(tmp_path, Judgement(task=spec.id, models=models, sizes=(20, 40)), spec, {}).after
        for models in (("copy",), (run,), (run, "copy"))
    }
    fitted = " after 40 transitions"
    assert list(said.values()) == [fitted, "", f"{fitted} (of trained agents, after their benches)"]


@pytest.mark.parametrize(("apart", "better"), [(0.035, "no difference is shown"), (0.1, "it is better")])
def test_the_two_best_models_that_learned_are_compared(tmp_path: Path, apart: float, better: str) -> None:
    """Seven seeds of each; of six pairs that are compared, one is of these two."""
    least = {"structured": 0.504 + apart, "exact": 0.0, "copy": 0.5 + apart, "gaussian": 0.5}
    held = {model: [score + 0.01 * seed for seed in range(7)] for model, score in least.items()}
    one = Judgement(task="pick_place", models=tuple(held), sizes=(40,))
    cells = {(model, 40): [{"unbiased": score} for score in scores] for model, scores in held.items()}
    section = compared(Judged(tmp_path, one, registry.task(one.task), cells))
    pairs = [statistics.difference(held[one], held[other]) for one, other in itertools.combinations(held, 2)]
    corrected = statistics.holm([each.p for each in pairs])
    shown = [[estimate(each, number), number(p)] for each, p in zip(pairs, corrected, strict=True)]
    assert [row[2:] for row in section.tables[0].rows] == shown and pairs[5].p < 0.05
    (said,) = section.answers
    assert f"{model_entry('gaussian').label} (0.530), then copy the last frame ({0.53 + apart:.3f}); " in said
    assert said.endswith(f"difference {shown[5][0]}, p = {shown[5][1]}, Holm-corrected: {better}.")


@pytest.mark.usefixtures("_few")
def test_a_run_that_was_made_anew_is_judged_anew(tmp_path: Path) -> None:
    wanted = small(budgets=(2,), agents=("imaginer",))
    (run,) = benches.bench(wanted, {}, root=tmp_path, launcher=Inline()).runs
    folder, one = _judged(tmp_path / "judge", str(run.folder), seeds=(1000,))
    assert len(kept(folder, one)) == 1
    shutil.rmtree(run.folder)
    benches.bench(wanted, {}, root=tmp_path, launcher=Inline())
    assert kept(folder, one) == []


def _source(name: str, task: str, appearance: str = "clean", encoder: str | None = None) -> ModelSource:
    spec = registry.task(task)
    return source_of(name, spec, RenderedFrameIndex(spec, appearance), appearance, SeedTree(1000), encoder)


def test_runs_that_cannot_be_judged_say_why(runs: dict[str, Path], tmp_path: Path) -> None:
    def visited(agent: str, task: str) -> set[tuple[State, int]] | None:
        source = _source(str(runs[agent]), task)
        with opened(source, task, folder=tmp_path, log=tmp_path / "log") as judged:
            return judged.visited

    assert model_entry(str(runs["table"])).title == "table, seed 0"
    with pytest.raises(InvalidValueError, match="does not imagine"):
        visited("table", "arrow_puzzle")
    with pytest.raises(InvalidValueError, match="learned arrow_puzzle, not pick_place"):
        visited("imaginer", "pick_place")
    with pytest.raises(ArtefactError, match="no run of an agent in runs/elsewhere/seed_0, seen from"):
        model_entry("runs/elsewhere/seed_0")
    found = visited("imaginer", "arrow_puzzle")
    assert found and len(found) <= 2 * 20, "its experience is the one that the bench counted"
    assert all(len(state) == 4 and 0 <= action < 6 for state, action in found)


@pytest.mark.usefixtures("own_names")
def test_the_truths_modules_are_closed_to_other_packages() -> None:
    """Also to a package whose name begins alike."""
    entry = dataclasses.replace(registry.task_entry("arrow_puzzle"), spec="theirs.rules:SPEC", env="theirs.worlds:Env")
    registry.TASKS["their_task"] = entry
    own, *_ = of_suite = closed_modules("arrow_puzzle", "theirs.models:make")
    assert own == "imagine_bench.tasks" and closed_modules("arrow_puzzle", "imagine_bench.agents.x:make") == [own]
    assert all(module.startswith(f"{own}.") for module in of_suite[1:])
    for make in ("others.models:make", "their.models:make", "imagine_bench.agents.x:make"):
        assert closed_modules("their_task", make) == [own, "theirs.rules", "theirs.worlds"]
    for make in ("theirs.models:make", "theirs:make"):
        assert closed_modules("their_task", make) == [own]


def test_a_run_is_judged_through_the_encoder_that_is_given(tmp_path: Path) -> None:
    own = tmp_path / "own.safetensors"
    shutil.copy(encoders.own(registry.task("arrow_puzzle"), "clean"), own)
    wanted = protocol("arrow_puzzle", "smoke", agents=("imagination",), encoder=encoders.identity(own))
    config = {"format": run_folder.FORMAT, "protocol": wanted.as_dict(), "agent": "imagination", "seed": 0}
    write_json(tmp_path / "config.json", sealed({**config, "settings": {}}))
    assert model_entry(str(tmp_path)).encoder_kind == "latents"
    for given, words in ((None, "which is not here"), (str(own), "has no checkpoint")):  # else it was found
        with pytest.raises(ArtefactError, match=words):
            _source(str(tmp_path), "arrow_puzzle", encoder=given)


def test_the_experience_of_a_run_is_not_known_where_others_were_learned_from(tmp_path: Path) -> None:
    after = {"after": ("arrow_puzzle_hard",), "after_episodes": 1, "unannounced": True}
    run = do(tmp_path, "imaginer", agents=("imaginer",), budgets=(2,), **after)
    source = dataclasses.replace(_source(str(run.folder), "arrow_puzzle"), privileged=True)
    with opened(source, "arrow_puzzle", folder=tmp_path, log=tmp_path / "log") as judged:
        assert judged.visited is None and not judged.learns


def test_rewards_with_feedback_in_them_are_not_compared_with_the_rules(tmp_path: Path) -> None:
    options = {"agents": ("imaginer",), "budgets": (2,), "open_loop_starts": 2}
    plain = do(tmp_path / "plain", "imaginer", **options)
    taught = do(tmp_path / "taught", "imaginer", feedback=5.0, **options)
    errors = [run.checkpoints[0].open_loop.reward_mae for run in (plain, taught)]  # type: ignore[union-attr]
    assert np.isfinite(errors[0]).all() and np.isnan(errors[1]).all()
    with pytest.raises(InvalidValueError, match="a teacher's feedback in them"):
        _source(str(taught.folder), "arrow_puzzle")


_TWICE = ("mdn_thesis:model.members=2,model.dropout=0.1", "copy", "mdn_thesis:model.dropout=0.1,model.members=2")


def test_nonsense_is_refused(runs: dict[str, Path]) -> None:
    run = runs["imaginer"]
    nonsense: tuple[tuple[str, dict[str, Any]], ...] = (
        ("ascending numbers", {"sizes": (30, 20)}),
        ("hide or delay a part .* without the parameters", {"task": "arrows:cubes=2,lag=1"}),
        ("the kinematic execution, which task 'arrow_puzzle_cloned' lacks", {"task": "arrow_puzzle_cloned"}),
        (
            r"No model of \('copy', 'structured'\) reads latents",
            {"models": ("copy", "structured"), "encoder": _LATENTS},
        ),
        ("give each world model or run once", {"models": _TWICE}),
        ("give each world model or run once", {"models": (str(run), str(run / ".." / "seed_0"))}),
    )
    for words, given in nonsense:
        with pytest.raises(InvalidValueError, match=words):
            Judgement(**{"task": "pick_place", "models": ("copy",), **given})


def test_models_learn_from_what_the_policy_collected(tmp_path: Path) -> None:
    """As many episodes as the transitions need, in the judgement's looks."""
    one = Judgement(task="arrow_puzzle", models=("copy",), sizes=(5, 12), policy="mixed", appearance="mild")
    data = data_of(one, tmp_path, 3)
    assert data.card is not None and len(data.episodes.actions) >= 12
    assert [data.card[name] for name in ("policy", "appearance", "execution", "seed")] == [
        *("mixed", "mild", "kinematic"), 3,
    ]  # fmt: skip
    states, lengths = iter(map(tuple, macrostates_of(data).tolist())), data.episodes.lengths.tolist()
    seen = [list(itertools.islice(states, length + 1))[:-1] for length in lengths]
    tried = list(zip(itertools.chain(*seen), data.episodes.actions.tolist(), strict=True))
    assert [judgement.visited(data, count) for count in (1, 5, 12)] == [set(tried[:count]) for count in (1, 5, 12)]


def test_judgements_that_cannot_be_compared_lie_apart() -> None:
    def folder(**changes: Any) -> str:
        return Judgement(**{"task": "pick_place", "models": ("gaussian",), **changes}).folder_name

    others = {
        "task": "arrow_puzzle", "sizes": (5,), "samples": 3, "appearance": "mild", "policy": "optimal", "order": 1,
        "encoder": _LATENTS,
    }  # fmt: skip
    assert len({folder(), *(folder(**{name: value}) for name, value in others.items())}) == 1 + len(others)
    for more in ({"models": ("copy", "exact")}, {"seeds": (7,)}, {"sizes": (2, 10_000)}):
        assert folder(**more) == folder(), "these are cells of one folder"


def test_a_judgement_is_of_the_world_that_a_file_describes_now(tmp_path: Path) -> None:
    file = tmp_path / "world.json"
    folders = []
    for horizon in (3, 4):
        file.write_text(f'{{"cubes": 1, "horizon": {horizon}}}')
        judgement = Judgement(task=f"arrows:@{file}", models=("copy",))
        assert judgement.task == f"arrows:cubes=1,horizon={horizon}"
        folders.append(judgement.folder_name)
    assert len(set(folders)) == 2


def test_models_take_the_given_encoder_if_it_is_of_their_kind() -> None:
    costs = [_source(name, "pick_place", encoder=_LATENTS).cost for name in ("gaussian", "structured")]
    assert [cost["encoder"] for cost in costs] == [_LATENTS, "pick_place-clean-codes"]
    card = json.loads(encoders.bundled()[_LATENTS].with_suffix(".json").read_text())
    assert costs[0]["encoder_frames"] == card["recipe"]["frames"] and "encoder_reads" not in costs[0]
    few = _source("structured", "arrow_puzzle", "strong").cost["encoder_reads"]
    assert few == pytest.approx(0.115, abs=1e-3)
