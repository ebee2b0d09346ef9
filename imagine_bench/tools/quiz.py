"""``imagine-bench play TASK --quiz N``: a person answers the questions about a whole world that models are asked."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from imagine_bench import registry
from imagine_bench.appearance import appearance_name
from imagine_bench.arrays import Floats, Pixels, State
from imagine_bench.errors import InvalidValueError, require_integer
from imagine_bench.interfaces import TaskSpec
from imagine_bench.judge.questions import FRAMES, STATES
from imagine_bench.judge.worlds.families import Family
from imagine_bench.judge.worlds.making import WorldQuestions, whole_world
from imagine_bench.judge.worlds.scores import scores_right
from imagine_bench.judge.worlds.tables import copying_table
from imagine_bench.judge.worlds.words import Words
from imagine_bench.recording.filmstrips import Tile, png, sheet
from imagine_bench.report.page import DASH, Table, percent
from imagine_bench.rules import states_of_play
from imagine_bench.seeding import SeedTree
from imagine_bench.store.files import make_folder, read_json, write_bytes

JUDGED = Path("runs/judge")
IMAGES = Path("runs/quiz")


def quiz(
    task: str,
    count: int,
    *,
    seed: int = 0,
    appearance: str = "clean",
    ask: Callable[[str], str] = input,
    judged: Path = JUDGED,
    folder: Path = IMAGES,
) -> str:
    """Ask a person ``count`` questions, and say how many answers were right, beside chance, models and the rules.

    Args:
        task: The task.
        count: Questions, at least 1.
        seed: Chooses the questions.
        appearance: How frames vary.
        ask: Prints a text and returns a line that the person typed. An EOFError ends the quiz.
        judged: Folder of judgements, from which the scores of models are read.
        folder: Where the images of the questions are written.

    Raises:
        InvalidValueError: No question is asked for, or the world is too large or too small or hides something.
        UnknownNameError: No such task or appearance.
    """
    require_integer("quiz", count, 1)
    spec = registry.task(task)
    look = appearance_name(appearance)
    rng = SeedTree(seed).child("quiz", spec.id).generator()
    states = states_of_play(spec.rules)
    if len(states) > STATES or spec.sight is not None:
        raise InvalidValueError(
            f"{task} has more than {STATES} macrostates in which an episode goes on, or its frames hide some of it, so "
            "that nothing is asked about its whole world; take another task, such as arrow_puzzle."
        )
    first = spec.render_macrostates(np.array(states[:1] * 2, dtype=np.int64), look, rng)
    asked = whole_world(spec, states, FRAMES, frames_vary=bool((first[0] != first[1]).any()))
    if not asked.families:
        raise InvalidValueError(f"{task} is too small a world to ask anything about; take another task.")
    place = make_folder(folder / spec.id)
    found: dict[str, list[Floats]] = {}
    for number in range(count):
        family = asked.families[number % len(asked.families)]
        row = int(rng.integers(len(family.options)))
        file = place / f"question_{number + 1}.png"
        try:
            chosen = _answers(asked, family, row, file, ask, partial(_image, spec, look, rng))
        except EOFError:
            break
        found.setdefault(family.name, []).append(_scores(asked, family, row, chosen))
    return _summary(found, _of_models(judged, spec.id, look))


def _image(spec: TaskSpec, look: str, rng: np.random.Generator, state: State) -> Pixels:
    return spec.render_macrostates(np.array([state], dtype=np.int64), look, rng)[0]


def _answers(
    asked: WorldQuestions,
    family: Family,
    row: int,
    file: Path,
    ask: Callable[[str], str],
    render: Callable[[State], Pixels],
) -> list[int]:
    """The options that a person chooses, one for each member of a question."""
    chosen = []
    for words in family.words(asked.named, row):
        write_bytes(file, png(sheet(rows_of(words, render, "question"))))
        lines = [f"\n{family.name.capitalize()}. {words.text} (Images: {file})"]
        lines += [f"  {i}  {answer}" for i, answer in enumerate(words.answers, 1)]
        print("\n".join(lines))
        number = 0
        most = len(words.answers) + len(words.answer_images)
        while not 1 <= number <= most:
            typed = ask(f"Number of your answer, 1 to {most}: ").strip()
            number = int(typed) if typed.isdecimal() else 0
        chosen.append(number - 1)
    return chosen


def rows_of(words: Words, render: Callable[[State], Pixels], name: str) -> list[tuple[str, list[Tile]]]:
    """The images of a question, and those to choose from, as rows of a sheet."""
    rows = [(name, [Tile(None if state is None else render(state), title) for title, state in words.images])]
    if words.answer_images:
        rows.append(("answers", [Tile(render(state), str(i)) for i, state in enumerate(words.answer_images, 1)]))
    return rows


# Scores ------------------------------------------------------------------------------------------------------------

_NAMES = ("you", "chance", "copy", "exact")


def _scores(asked: WorldQuestions, family: Family, row: int, chosen: Sequence[int]) -> Floats:
    """The scores of one question: of the person, of chance, of copying and of the rules. A pair counts as one."""
    exact = family.answer(asked.truth)[row]
    copied = family.answer(copying_table(asked.truth))[row]
    exact = exact.reshape(-1, exact.shape[-1])
    person = np.eye(exact.shape[1])[list(chosen)]
    held = (person, np.ones_like(exact), copied.reshape(exact.shape), exact)
    return np.array([scores_right(exact, each).prod() for each in held])


def _of_models(judged: Path, task: str, look: str) -> dict[str, dict[str, float]]:
    """The scores by family of each model, after the most transitions, in the latest judgement of a task."""
    kept = [path.parent for path in judged.glob("*/judgement.json") if (path.parent / "report/worlds.csv").exists()]
    fitting = []
    for path in kept:
        facts = read_json(path / "judgement.json", "a judgement")
        if (facts["task"], facts["appearance"]) == (task, look):
            fitting.append(path / "report/worlds.csv")
    if not fitting:
        return {}
    latest = max(fitting, key=lambda path: path.stat().st_mtime)
    rows = [row for row in csv.DictReader(latest.read_text().splitlines()) if row["right"]]
    most = max((int(row["transitions"]) for row in rows), default=0)
    every: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        if int(row["transitions"]) == most:
            every.setdefault(row["model"], {}).setdefault(row["family"], []).append(float(row["right"]))
    return {model: {name: float(np.mean(each)) for name, each in scores.items()} for model, scores in every.items()}


def _summary(found: dict[str, list[Floats]], models: dict[str, dict[str, float]]) -> str:
    """A table of families: the person and models."""
    if not found:
        return "No question was answered."
    others = [model for model in models if model not in _NAMES]
    rows = []
    for family, scores in found.items():
        means = np.mean(scores, axis=0)
        held = [percent(models[model][family]) if family in models[model] else DASH for model in others]
        rows.append([family, str(len(scores)), *map(percent, means.tolist()), *held])
    table = Table("quiz", ["family", "questions", *_NAMES, *others], rows)
    remark = "Percent: the mean exact probability of the chosen answers. The first columns are of your questions"
    more = ", those of models of all questions of a family." if others else "; no judgement of models is kept here."
    return f"\n{table.text}\n\n{remark}{more}"
