"""How far the models of a bench's agents generalise to transitions that no training can contain."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine_bench import reference
from imagine_bench.capabilities import Imaginer
from imagine_bench.interfaces import TaskSpec
from imagine_bench.judge.filmstrips import rgb, transition_sheet
from imagine_bench.judge.generalisation import Generalisation, Predictions, generalisation, predict, transition_set
from imagine_bench.report.analysis import MEANS, Analysis, Groups, Measured, analyse, markdown
from imagine_bench.report.text import agent_words, mean_text
from imagine_bench.seeding import Purpose, SeedTree
from imagine_bench.store.trained import Trained

Found = tuple[Predictions, Generalisation]

_ROWS = {
    "unseen": ("unseen.right", "next macrostate right, out of terminal macrostates (never seen), %"),
    "unseen_legal": ("unseen_legal.right", "of these out of legal ones (goals), %"),
    "unseen_likeliest": (
        "unseen.likeliest_right",
        "of all these by what the model holds likeliest, instead of what it samples, %",
    ),
    "seen": ("seen.right", "next macrostate right, out of all others, %"),
    "seen_likeliest": ("seen.likeliest_right", "of these by what the model holds likeliest, %"),
    "auroc": ("auroc", "epistemic uncertainty tells the unseen from the others (AUROC, %)"),
}
"""The figures of summary.json: where they are found in a :class:`.Generalisation`, and their row of the table."""


def generalisation_report(
    folder: Path | None, *, root: Path, task: str | None, encoder: str | None, overrides: Sequence[tuple[str, Any]] = ()
) -> str:
    """Let the model of every imagining run of a bench predict all transitions: :func:`.analysis.analyse`."""
    return analyse(GeneralisationAnalysis, folder, root=root, task=task, encoder=encoder, overrides=overrides)


class GeneralisationAnalysis(Analysis[Found]):
    """What each model predicts of every transition, seen or not."""

    name = "generalisation"
    heading = "transitions that no training can contain"
    rows_file = "transitions.csv"

    def __init__(self, spec: TaskSpec, *, appearance: str, purpose: Purpose = "evaluation") -> None:
        super().__init__(spec, appearance=appearance, purpose=purpose)
        self.transitions = transition_set(spec, appearance=appearance, purpose=purpose)

    def measure(self, trained: Trained) -> Found | None:
        """Its predictions; None for an agent that does not imagine."""
        if not isinstance(trained.agent, Imaginer):
            return None
        return self.scored(trained.agent, SeedTree(trained.spec.seed).child(self.name))

    def scored(self, agent: Imaginer, seeds: SeedTree) -> Found:
        """An agent's predictions and their scores."""
        predictions = predict(agent, self.transitions, seeds)
        return predictions, generalisation(self.transitions, predictions)

    def table(self, runs: Sequence[Measured[Found]]) -> str:
        """Means over the seeds of each agent with 95 % intervals, as Markdown, the thesis' figure beside them."""
        spec, groups = self.spec, Groups(runs)
        thesis = {} if spec.reference is None else reference.load(spec.reference).get("generalisation", {})
        terminal = self.transitions.terminal
        unseen = int(terminal.sum())
        heads = [f"{title} ({len(seeds)} seed(s))" for title, seeds in zip(groups.titles, groups.values(), strict=True)]
        rows = []
        for name, (figure, words) in _ROWS.items():
            cells = [mean_text([attrgetter(figure)(found) for _, found in seeds]) for seeds in groups.values()]
            there = f"{thesis['correct']} (of {thesis['attempted']})" if name == "unseen" and thesis else "–"
            if any(cell != "–" for cell in (*cells, there)):
                rows.append([words, *cells, there])
        lines = [
            f"{unseen} transitions out of terminal macrostates, {len(terminal) - unseen} others; {MEANS}",
            "",
            *markdown([spec.title, *heads, "thesis"], rows),
            "",
            *_by_consequence(groups),
            *_by_visit_count(groups),
        ]
        return "\n".join(lines)

    def rows(self, runs: Sequence[Measured[Found]]) -> Iterable[Sequence[object]]:
        """One row a run and transition."""
        yield [
            "agent", "seed", "episodes", "macrostate", "action", "terminal", "legal", "consequence",
            "right", "end_right", "reward_error", "epistemic", "likeliest_right", "visit_count",
        ]  # fmt: skip
        transitions = self.transitions
        consequences = transitions.consequences
        for run in runs:
            found, _ = run.value
            for index, state in enumerate(transitions.macrostates):
                integers = (found.right, found.end_right, found.likeliest_right, found.visit_count)
                right, end, likeliest, visits = ("" if each is None else int(each[index]) for each in integers)
                yield [
                    *run.head.values(), " ".join(map(str, state)), int(transitions.actions[index]),
                    int(transitions.terminal[index]), int(transitions.legal[index]), consequences[index], right, end,
                    f"{found.reward_error[index]:.6g}", f"{found.epistemic[index]:.6g}", likeliest, visits,
                ]  # fmt: skip

    def figure(self, runs: Sequence[Measured[Found]]) -> tuple[NDArray[np.uint8], str]:
        """A few of the unseen transitions, as the first seed of each agent imagines them (thesis' figure 5.9)."""
        there, shown = self.transitions, self.transitions.shown
        first = {run.agent: run for run in reversed(runs)}
        rows: list[tuple[str, Sequence[NDArray[np.uint8]], Sequence[bool] | None]] = [
            ("before", list(there.frames[shown]), None), ("after, by the rules", list(there.frames_after), None),
        ]  # fmt: skip
        for run in (first[run.agent] for run in runs if run is first[run.agent]):
            found, _ = run.value
            images = [rgb(example.frames[0]) for example in found.examples]
            rows.append((f"{agent_words(run.agent).title}, seed {run.seed}", images, found.right[shown].tolist()))
        titles = [self.spec.action_names[there.actions[index]] for index in shown]
        return transition_sheet(titles, rows), "Transitions out of terminal macrostates: real above, imagined below"

    def summary(self, value: Found) -> dict[str, Any]:
        """The figures of the table."""
        _, found = value
        figures = {name: attrgetter(figure)(found) for name, (figure, _) in _ROWS.items()}
        return {**figures, **{name: asdict(found)[name] for name in ("consequences", "visit_counts")}}


def _by_consequence(groups: Groups[Found]) -> list[str]:
    """The transitions that training can contain, by what the rules say comes of them: one row an agent and kind."""
    rows = []
    for title, seeds in zip(groups.titles, groups.values(), strict=True):
        for name, first in seeds[0][1].consequences.items():
            scores = [found.consequences[name] for _, found in seeds]
            right = mean_text([one.right for one in scores])
            end = mean_text([one.end_right for one in scores])
            reward = mean_text([one.reward_error for one in scores], "{:.2f}".format)
            rows.append([title, name, first.count, right, end, reward])
    head = ("agent", "consequence", "transitions", "next macrostate right, %", "end right, %", "reward's mean error")
    return ["The others, by what the rules say comes of them:", "", *markdown(head, rows)]


def _by_visit_count(groups: Groups[Found]) -> list[str]:
    """The same transitions by the agents' visit counts: one row an agent that knows them, and count."""
    rows = []
    for title, seeds in zip(groups.titles, groups.values(), strict=True):
        for name in seeds[0][1].visit_counts:
            scores = [found.visit_counts[name] for _, found in seeds]
            count = mean_text([float(one.count) for one in scores], "{:.0f}".format)
            right = mean_text([one.right for one in scores])
            likeliest = mean_text([one.likeliest_right for one in scores])
            rows.append([title, name, count, right, likeliest])
    if not rows:
        return []
    head = ("agent", "visits", "transitions", "next macrostate right, %", "by what the model holds likeliest, %")
    return ["", "The others, by how many real visits of them the agent remembers:", "", *markdown(head, rows)]
