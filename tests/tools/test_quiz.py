"""A person answers the questions that models are asked; scores stand beside those of chance, models and the rules."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from guest_packages import Guests
from PIL import Image

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError
from imagine_bench.judge.worlds.families import ShortestPlans
from imagine_bench.judge.worlds.making import whole_world
from imagine_bench.rules import states_of_play
from imagine_bench.tools.quiz import quiz

EASY = "arrow_puzzle_easy"
_TINY = """
import numpy as np
from imagine_bench.interfaces import Outcome, TaskSpec
from imagine_bench.registry import TaskEntry
from imagine_bench.rules import facts

class Rules:
    n_actions = 1
    states = ((0,), (1,))
    start_states = ((0,),)
    def outcomes(self, macrostate, action):
        return (self.judge(macrostate, action, (1,)),)
    def judge(self, macrostate, action, reached):
        return Outcome(1.0, reached, 1.0, terminated=True, success=True)
    def is_legal(self, macrostate):
        return True
    def is_terminal(self, macrostate):
        return macrostate == (1,)
    def optimal_action(self, macrostate):
        return 0

def frames(macrostates, appearance, rng):
    return np.zeros((len(macrostates), 64, 64, 3), dtype=np.uint8)

SPEC = TaskSpec(
    id="tiny", title="Tiny", description="One button.", env_id="tiny/Tiny-v0", horizon=1, action_names=("press",),
    macrostate_names=("lamp",), macrostate_values=(("off", "on"),), preprocessing="small_rgb", encoder="tiny",
    rules=Rules(), facts=lambda: facts(Rules(), 1), render_macrostates=frames,
)
ENTRY = TaskEntry(spec="tiny:SPEC", env_id="tiny/Tiny-v0", env="tiny:Env", horizon=1)
"""
"""A world of one macro-action, of which nothing can be asked."""


def typed(*words: str) -> Callable[[str], str]:
    """A person who types these and leaves."""
    return mock.Mock(side_effect=[*words, EOFError])


@pytest.mark.parametrize("task", ["arrow_puzzle", "pick_place"])
def test_every_family_has_words_and_an_answer_for_each_option(task: str) -> None:
    spec = registry.task(task)
    asked = whole_world(spec, states_of_play(spec.rules), 2, frames_vary=True)
    for family in asked.families:
        options = np.atleast_2d(family.options[0])
        found = family.words(asked.named, 0)
        assert len(found) == len(options)
        for words, mine in zip(found, options, strict=True):
            assert words.text and words.images
            assert len({*words.answers} | {*words.answer_images}) == len(mine), family.name


def test_a_person_is_asked_until_the_last_question_or_until_leaving(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    judged = ((EASY, "clean", "0.5"), (EASY, "clean", "0.75"), (EASY, "mild", "1"), ("arrow_puzzle", "clean", "1"))
    for made_s, (task, look, right) in enumerate(judged):  # the later ones are of other looks and of another task
        report = tmp_path / "judge" / str(made_s) / "report"
        report.mkdir(parents=True)
        (report.parent / "judgement.json").write_text(json.dumps({"task": task, "appearance": look}))
        rows = ["model,transitions,seed,family,right", "patches,9,0,masked frame,0.1"]
        rows += [f"patches,30,{seed},masked frame,{each}" for seed, each in enumerate(("0.25", right))]
        (report / "worlds.csv").write_text("\n".join(rows))
        os.utime(report / "worlds.csv", (made_s, made_s))
    said = quiz(EASY, 8, ask=typed("x", "0", "9", "1", "2", "1"), judged=tmp_path / "judge", folder=tmp_path)
    lines = [line.split() for line in said.splitlines()]
    assert ["family", "questions", "you", "chance", "copy", "exact", "patches"] in lines
    (masked,) = (line for line in lines if line[:2] == ["masked", "frame"])
    assert masked[2] == "1" and masked[3] in ("0.0", "100.0") and masked[-2:] == ["100.0", "50.0"]
    (plan,) = (line for line in lines if line[:2] == ["shortest", "plan"])
    assert plan[-1] == "–", "the model was not judged on it"
    (reached,) = (line for line in lines if line[:1] == ["reachability"])
    answered = ["1", "0.0", "50.0", "100.0", "100.0", "–"]
    assert reached[1:] == answered, "the goal is two away: whoever says that nothing changes is right, yes is wrong"
    images = sorted((tmp_path / EASY).glob("*.png"))
    assert [image.name for image in images] == [f"question_{number}.png" for number in (1, 2, 3, 4)]
    assert all(np.asarray(Image.open(image)).std() > 1.0 for image in images)
    assert "Masked frame. First “" in capsys.readouterr().out
    whole = quiz(EASY, 8, ask=mock.Mock(return_value="1"), judged=tmp_path, folder=tmp_path).splitlines()
    (pairs,) = (line.split() for line in whole if line.startswith("single-cause pairs"))
    assert (pairs[2], pairs[4], pairs[6]) == ("1", "6.2", "100.0"), "a pair is right if both are, of four answers each"
    assert quiz(EASY, 1, ask=typed(), judged=tmp_path, folder=tmp_path) == "No question was answered."


def test_the_number_beside_the_right_answer_is_right_and_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = registry.task(EASY)
    world = whole_world(spec, states_of_play(spec.rules), 2, frames_vary=True)
    (plans,) = (family for family in world.families if isinstance(family, ShortestPlans))
    one = replace(plans, starts=plans.starts[:1], goals=plans.goals[:1], options=plans.options[:1])
    monkeypatch.setattr("imagine_bench.tools.quiz.whole_world", lambda *_, **__: replace(world, families=(one,)))
    (right,) = one.options[one.answer(world.truth) == 1.0].tolist()
    scores = {}
    for number in range(1, one.options.size + 1):
        wrong = ["0", str(one.options.size + 1), "", "-1", "1.0"]
        said = quiz(EASY, 1, ask=typed(*wrong, str(number)), judged=tmp_path, folder=tmp_path)
        (row,) = (line.split() for line in said.splitlines() if line.startswith("shortest plan"))
        answers = dict(line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("  "))
        scores[int(answers[str(number)])] = float(row[3])
    assert scores == {steps: 100.0 * (steps == right) for steps in one.options[0].tolist()}


def test_a_world_too_small_for_questions_is_refused(guests: Guests, tmp_path: Path) -> None:
    guests.write("tiny", _TINY, {registry.TASK_GROUP: {"tiny": "tiny:ENTRY"}})
    with pytest.raises(InvalidValueError, match="tiny is too small a world to ask anything about"):
        quiz("tiny", 1, ask=typed(), judged=tmp_path, folder=tmp_path / "images")
    assert not (tmp_path / "images").exists()
