"""Sections of a bench's page on single episodes, on why agents failed, and on imagination."""

from __future__ import annotations

import csv
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from imagine_bench.arrays import Arrays
from imagine_bench.interfaces.model import UNCERTAINTIES
from imagine_bench.judge.causes import CAUSES, CAUSES_OF_PLAYERS, FORMER_CAUSES
from imagine_bench.recording.filmstrips import episode_strip, filmstrip, png, sampled_filmstrips
from imagine_bench.registry.entries import file_name
from imagine_bench.report import figures
from imagine_bench.report.data import SCORE, ReportData, open_loop_means
from imagine_bench.report.page import DASH, Image, Section, Table, percent
from imagine_bench.store.files import reading
from imagine_bench.store.run_folder import recording_path

HEAD = ("agent", "seed", "episodes", "tests", "test", "cause")
"""Columns of ``why/causes.csv``: a row a failure, and one a test without any, whose cause is empty."""
SHOWN_ROLLOUTS = 3  # rollouts shown of each imagining agent: the first ones of its first seed
_MEASURES = {
    "correct": "macrostate right (%)",
    "correct_accepted": "right among those kept (%)",
    "accepted": "kept by the filter (%)",
    "termination_error": "wrong about the end (%)",
    "auroc_epistemic": "wrong ones found by epistemic (AUROC)",
    "auroc_aleatoric": "by aleatoric",
    "auroc_modal": "by modal",
    "reward_mae": "reward error",
    "epistemic": "epistemic",
    "aleatoric": "aleatoric",
    "modal": "modal",
}


# Episodes ---------------------------------------------------------------------------------------------------------


def episodes(data: ReportData) -> Section | None:
    """A recorded episode that was solved and one that was not, both of the best agent that has such, as filmstrips."""
    last = {agent: data.of(agent)[-1][SCORE[0]] for agent in data.result.protocol.agents}
    best_first = sorted(last, key=lambda agent: (agent in data.learners, last[agent]), reverse=True)
    runs = [run for agent in best_first for run in data.result.of(agent) if run.recorded]
    if not runs or not data.installed:
        return None
    images = []
    for name, wanted in (("solved", True), ("failed", False)):
        found = [(run, each) for run in runs for each in run.recorded if bool(each.success) is wanted]
        for run, episode in found[:1]:
            strip = png(episode_strip(episode, data.spec.action_names))
            images.append(Image(f"episode_{name}", strip, f"{run.agent}, seed {run.seed}: {episode.end}."))
    words = (
        "These are greedy episodes after the last training. They are recorded beside the tests, from starts of their "
        "own, and count in no table. Shown are the first that was solved and the first that was not, of the best "
        "learner that has such. The recordings below hold all such episodes, with the scene and the agent's "
        "predictions; “imagine-bench view FILE” opens one.",
    )
    page = data.result.folder / "report"
    links = {f"{run.agent}, seed {run.seed}": os.path.relpath(recording_path(run.folder), page) for run in runs}
    return Section("One episode that was solved, and one that was not", words, images, links=links)


# Why agents failed ------------------------------------------------------------------------------------------------


def causes(data: ReportData) -> Section | None:
    """Causes by agent and budget, where 'imagine-bench verify --causes' left them in the bench's folder."""
    table = read_causes(data.result.folder)
    words = (
        "An episode that an optimal policy fails with the same draws of chance, too, was bad luck. Else truth is "
        "swapped in, one stage at a time, until the episode is solved: frames read right; then a perfect plan in the "
        "agent's own model; then the truth about transitions that it never experienced; then all of the truth; then "
        "every macro-action carried out as the rules say. The first stage that solves it names the cause."
    )
    return Section("Why agents failed", [words], tables=[table]) if table.rows else None


def read_causes(bench: Path) -> Table:
    """The causes that were found of a bench; without rows where nothing was. Raises ArtefactError: the file is
    damaged.
    """
    path = bench / "why" / "causes.csv"
    if not path.is_file():
        return causes_table([])
    with reading(path, "a table of causes"):
        head, *rows = csv.reader(path.read_text().splitlines())
        if tuple(head) != HEAD:
            raise ValueError(f"its columns are {head}")
        return causes_table(rows)


def causes_table(rows: Iterable[Sequence[object]]) -> Table:
    """Shares of the failures of all seeds by agent and budget, from rows below :data:`HEAD`; no cause is no failure.

    Raises:
        ValueError: A cause that is none.
    """
    counts: dict[tuple[str, str], Counter[str]] = {}
    tested: dict[tuple[str, str], dict[str, int]] = {}
    for agent, seed, budget, tests, _, named in (map(str, row) for row in rows):
        cause = FORMER_CAUSES.get(named, named)
        if cause not in ("", *CAUSES, *CAUSES_OF_PLAYERS):
            raise ValueError(f"{named!r} is no cause")
        tested.setdefault((agent, budget), {})[seed] = int(tests)
        counts.setdefault((agent, budget), Counter())[cause] += bool(cause)
    happened = {cause for found in counts.values() for cause in found}
    more = {cause: words for cause, words in CAUSES_OF_PLAYERS.items() if cause in happened}
    causes = {**CAUSES, **more}
    lines = []
    for (agent, budget), found in counts.items():
        failures = found.total()
        shares = [percent(found[name] / failures) if failures else DASH for name in causes]
        of = f"{failures:,} of {sum(tested[agent, budget].values()):,}"
        lines.append([agent, f"{int(budget):,}", of, *shares])
    header = ["agent", "real episodes", "failures", *(f"{name}, %" for name in causes)]
    meanings = "; ".join(f"{name}: {words}" for name, words in causes.items())
    return Table("causes", header, lines, f"Shares of the failures. {meanings}.", why_dash="nothing failed")


# Imagination ----------------------------------------------------------------------------------------


def open_loop(data: ReportData) -> Section | None:
    """Imagination against the rules by depth."""
    loops = open_loop_means(data.result)
    if not loops:
        return None
    words = (
        "Imagination against the rules at the last budget: from real images, the model predicts ahead without looking "
        "again, and a probe that the agents never use reads the macrostate (the discrete state of the task) from its "
        "images. Only chains of macro-actions that end no episode whatever chance may bring are compared. Means "
        "over seeds.",
        "AUROC: among transitions that began in the right macrostate, the probability that one that goes wrong has the "
        "higher uncertainty of two; 0.5 is chance, 1 is perfect.",
    )
    image = figures.image("open_loop", lambda: open_loop_figure(loops), "By imagined depth; means over seeds.")
    return Section("Open-loop error by depth", words, [image])


def open_loop_figure(loops: Mapping[str, Arrays]) -> Figure:
    """The measures by imagined depth, a panel each; an agent that knows no such uncertainty says 0."""
    panels: dict[str, dict[str, dict[int, float]]] = {}
    for name, title in _MEASURES.items():
        scale = 100.0 if "%" in title else 1.0
        known = {agent: loop[name] for agent, loop in loops.items() if name not in UNCERTAINTIES or loop[name].any()}
        panels[title] = {agent: dict(enumerate(scale * by_depth, 1)) for agent, by_depth in known.items()}
    return figures.lines(panels, figures.line_styles(loops), "imagined depth (macro-actions)")


def rollouts(data: ReportData) -> Section | None:
    """Imagined rollouts beside the real ones, and several sampled from one start, of each agent's first seed."""
    images = []
    for agent in data.result.protocol.agents if data.installed else ():
        run = data.result.of(agent)[0]
        whose = f"{agent}, seed {run.seed}"
        for start, compared in enumerate(run.imagined[:SHOWN_ROLLOUTS], 1):
            strip = png(filmstrip(compared, data.spec.action_names))
            images.append(Image(f"rollout_{file_name(agent)}_{start}", strip, f"{whose}, start {start}."))
        if run.sampled_rollouts:
            sheet = png(sampled_filmstrips(run.sampled_rollouts, data.spec))
            caption = f"{whose}: the same start {len(run.sampled_rollouts)} times."
            images.append(Image(f"sampled_rollouts_{file_name(agent)}", sheet, caption))
    words = (
        "Imagined rollouts of the trained agents, by their own greedy choice of macro-actions, decoded back into "
        "images. Top row: frames of the real environment for the same macro-actions. Bottom row: the agent's "
        "imagination; a blue frame where it is as the rules say, an orange one where not. The first of a few starts "
        "are shown, which are the same for every agent; not the best.",
        "Where the next macrostate is partly chance, several rollouts are sampled from one real image, a row each. "
        "Below each image stand the changes: in blue where the rules make it possible, in orange where not.",
    )
    return Section("The imagination of the agents", words, images) if images else None
