"""The report of a judgement: scores by question, futures beside the truth, and what models know of their errors."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine_bench import registry
from imagine_bench.arrays import Arrays
from imagine_bench.interfaces import TaskSpec
from imagine_bench.judge.change import FALSE_ALARMS, LENGTH, SLIP
from imagine_bench.judge.judgement import Judgement, kept, prepare, shown
from imagine_bench.judge.models import model_entry, runs_of
from imagine_bench.judge.scores import COVERAGES
from imagine_bench.judge.truth import sampling_noise_floor, shares
from imagine_bench.recording.filmstrips import png, transition_sheet
from imagine_bench.registry.entries import file_name
from imagine_bench.report import figures
from imagine_bench.report.page import flat, write_page
from imagine_bench.report.tables import DASH, Cell, Image, Page, Section, Table, estimate, number, p_value
from imagine_bench.rules import fewest_actions
from imagine_bench.statistics import Estimate, difference, holm, interval, iqm
from imagine_bench.store.files import csv_text, read_json

QUESTIONS = {
    "Which outcomes, how likely?": {
        "total_variation": "total variation, 1 step", "tv_3": "3 steps", "tv_5": "5 steps", "tv_10": "10 steps",
        "after_the_end": "after the end", "missed": "missed outcomes", "invented": "invented", "nothing": "no picture",
        "outcome_ece": "calibration error", "outcome_brier": "Brier",
    },
    "Which rewards and ends?": {
        "reward_error": "reward error", "reward_ece": "calibration error", "reward_brier": "Brier",
        "end_error": "end error", "end_ece": "calibration error", "end_brier": "Brier",
    },
    "What do mistakes cost?": {
        "value_loss": "value loss", "worst_value_loss": "from the worst start", "regret": "regret of 1 of 5",
    },
    "Does it know?": {
        "auroc_wrong": "AUROC, wrong", "auroc_never": "never seen", "auroc_either": "either",
        "auroc_after_the_end": "after the end", "auroc_noisy": "aleatoric, noisy", "auroc_several": "modal, several",
        "filter_keeps": "its filter keeps",
        "filter_error": "error of that", "filter_skill": "skill of its filter", "best_skill": "of the best threshold",
        "worth_of_refusing": "worth of refusing", "worth_of_filter": "worth of its filter",
    },
    "Does it notice?": {
        "notice_slip": "transitions until a slip", "notice_coupling": "until a coupling",
        "counterfactual": "counterfactuals wrong",
    },
    "What does it cost?": {
        "fit_s": "CPU s to fit", "imagine_s_per_1000": "CPU s, 1,000 steps", "parameters": "parameters",
        "encoder_frames": "frames beforehand",
    },
}  # fmt: skip
"""Scores by question: what a column of theirs is called."""
COLUMNS = {name: words for columns in QUESTIONS.values() for name, words in columns.items()}
_WORDS = {
    "Which outcomes, how likely?": "Total variation to the exact distribution, 0 for equal ones and 1 for those that "
    "share nothing, also of transitions after the end of an episode, which no data contains; missed and invented "
    "outcomes a transition; the share of pictures that show nothing of this world.",
    "Which rewards and ends?": "Error of the expected reward, in units of reward, and of the probability of the end. "
    "For calibration and Brier score a reward counts as the nearest that the rules give.",
    "What do mistakes cost?": "V* - V of the policy that is optimal in the model, mean over starts, and the exact "
    "return that the sequence ranked first of five leaves to the best. In units of reward.",
    "Does it know?": "AUROC of the epistemic uncertainty for transitions imagined wrongly, never seen in the data, or "
    "either, and for those after the end; of the aleatoric for random ones; of the modal for several outcomes. Skill: "
    "the share of wrong ones that a filter discards, less that of right ones; the best threshold of the epistemic "
    "uncertainty is chosen with the truth, and a filter may read more. Worth: reward a start that planning gains "
    "without the macro-actions it knows least of (the best share, chosen with the truth), and without those that its "
    "own filter discards.",
    "Does it notice?": f"Random transitions until a detector of surprise says that every macro-action slips with "
    f"probability {SLIP}, or that one also does what another does, at false alarms in {FALSE_ALARMS:.0%} of "
    f"unchanged streams of {LENGTH}; {LENGTH}: never. Counterfactuals: what it imagines of two macro-actions with the "
    "same draws that cannot both be.",
    "What does it cost?": "On one core. What was spent on an encoder beforehand is in frames.",
}
SHORT = ("total_variation", "tv_10", "nothing", "value_loss", "auroc_wrong", "notice_slip", "counterfactual", "fit_s")
_SHARES = {
    *("total_variation", "tv_3", "tv_5", "tv_10", "after_the_end", "nothing"),
    *("outcome_ece", "reward_ece", "end_error", "end_ece"),
    *("filter_keeps", "filter_error", "best_skill", "counterfactual"),
    *(name for name in COLUMNS if name.startswith("auroc")),
}
_WHY_DASH = "not offered by the model, or nothing to tell apart"
Series = dict[str, dict[Any, float]]
Panels = dict[str, Series]
Pixels = NDArray[np.uint8]
Rows = Sequence[tuple[str, Sequence[Pixels], Sequence[bool] | None]]


@dataclass(frozen=True)
class Judged:
    """A judgement and what is kept of it."""

    folder: Path
    judgement: Judgement

    @cached_property
    def cells(self) -> dict[tuple[str, int], list[dict[str, Any]]]:
        """Kept cells, one a seed, by model and transitions."""
        grouped: dict[tuple[str, int], list[dict[str, Any]]] = {}
        for cell in kept(self.folder, self.judgement):
            grouped.setdefault((cell["model"], cell["transitions"]), []).append(cell)
        return grouped

    @property
    def spec(self) -> TaskSpec:
        """The task."""
        return registry.task(self.judgement.task)

    @property
    def last(self) -> int:
        """The most transitions that models learned from."""
        return self.judgement.sizes[-1]

    @property
    def models(self) -> list[str]:
        """The models that are judged at the most transitions."""
        return [model for model in self.judgement.models if (model, self.last) in self.cells]

    @property
    def after(self) -> str:
        """What models had learned from; nothing where all are trained agents, which learned in their benches."""
        return f" after {self.last:,} transitions" if self.judgement.learning else ""

    @cached_property
    def images(self) -> dict[str, Arrays]:
        """Arrays of the images that are kept, by model."""
        return shown(self.folder, self.judgement)

    def means(self, name: str, places: Sequence[float], size: int, models: Iterable[str]) -> Series:
        """Means over seeds of a curve that models have at these places, by model."""
        found = {}
        for model in models:
            if own := [cell[name] for cell in self.cells.get((model, size), []) if cell[name]]:
                found[model] = dict(zip(places, np.mean(own, axis=0).tolist(), strict=True))
        return found

    def scores(self, model: str, size: int, name: str) -> list[float]:
        """A score of each seed, by name; ``tv_5`` is the total variation at depth 5. NaN where there is none."""
        return [score(cell, name) for cell in self.cells.get((model, size), [])]


def score(cell: Mapping[str, Any], name: str) -> float:
    """A score of a cell."""
    value = cell["tv_by_depth"][int(name[3:]) - 1] if name.startswith("tv_") else cell[name]
    digits = 3 if name.endswith("_s") else 9  # a time of less than a millisecond is none
    return math.nan if value is None else round(float(value), digits)


def judgement_report(folder: Path, judgement: Judgement) -> str:
    """Write ``folder / "report"`` and return the short table and where everything lies."""
    page = judgement_page(Judged(folder, judgement))
    return f"{page.summary}\n\nReport: {write_page(folder / 'report', page)}"


def judgement_page(found: Judged) -> Page:
    """The page of a judgement."""
    judgement = found.judgement
    short = _scores_table(found, "short", SHORT, judgement.sizes)
    data = f"Data: {judgement.policy} policy, kinematic" if judgement.learning else "Trained agents"
    sections = [section(found) for section in SECTIONS]
    return Page(
        title=f"{found.spec.title}: world models against the exact truth",
        subtitle=f"{data} · appearance “{judgement.appearance}” · {judgement.samples} futures a question",
        question="Which model imagines what really happens, how sure is it, and what do its mistakes cost?",
        answers=[answer for section in sections if section for answer in section.answers],
        sections=[section for section in sections if section],
        files={"scores.csv": _csv(found)},
        facts=flat("", read_json(found.folder / "judgement.json", "a judgement")),
        protocol=flat("", dataclasses.asdict(judgement)),
        summary=short.text,
    )


def _csv(found: Judged) -> str:
    rows: list[list[object]] = [["model", "transitions", "seed", *COLUMNS]]
    for (model, size), cells in found.cells.items():
        for cell in cells:
            values = [score(cell, name) for name in COLUMNS]
            rows.append([model, size, cell["seed"], *("" if math.isnan(v) else f"{v:.6g}" for v in values)])
    return csv_text(rows)


# Scores ------------------------------------------------------------------------------------------------------------


def mean_cell(values: Sequence[float], *, share: bool = False) -> Cell:
    """Interquartile mean over seeds with its 95 % interval, of a ``share`` in [0, 1]; a dash for no number."""
    there = [value for value in values if not math.isnan(value)]
    if not there:
        return Cell(DASH)
    low, high = interval(there, share=share)
    return estimate(Estimate(iqm(there), math.nan if low == high else low, high), _number)


def _number(value: float) -> str:
    return f"{value:,.0f}" if value >= 1_000 else number(value)


def _title(model: str) -> str:
    return model_entry(model).title


def _heads(found: Judged, model: str, size: int) -> list[str | Cell]:
    """The model and its transitions; those of a trained agent are its bench's to say."""
    return [_title(model), DASH if runs_of(model) else f"{size:,}"]


def _scores_table(found: Judged, name: str, names: Iterable[str], sizes: Sequence[int], folded: str = "") -> Table:
    names = list(names)
    rows = []
    for model, size in itertools.product(found.judgement.models, sizes):
        if (model, size) in found.cells:
            cells = [mean_cell(found.scores(model, size, each), share=each in _SHARES) for each in names]
            rows.append([*_heads(found, model, size), *cells])
    header = ["world model", "transitions", *(COLUMNS[each] for each in names)]
    caption = "Interquartile means over seeds or runs, with 95 % intervals. 0 is best in every error; value loss is in "
    return Table(name, header, rows, f"{caption}units of reward.", _WHY_DASH, folded)


def in_short(found: Judged) -> Section:
    """The main scores at the most transitions, and the reader's own errors."""
    errors = {name: f"{share:.2%}" for name, share in read_json(found.folder / "reader.json", "errors").items()}
    reader = Table("reader", list(errors), [list(errors.values())], "What the reader of images gets wrong itself.")
    words = (
        "A reader that was trained apart turns imagined images into macrostates. Of real frames, it misreads some or "
        "refuses to read them; fog, noise and blends of two frames should not be read."
    )
    return Section("In short", [words], tables=[_scores_table(found, "short", SHORT, [found.last]), reader])


def question(found: Judged, title: str) -> Section:
    """The scores that answer one question, after every number of transitions."""
    name = title.lower().strip("?").replace(" ", "_").replace(",", "")
    table = _scores_table(found, name, QUESTIONS[title], found.judgement.sizes, "After every number of transitions")
    return Section(title, [_WORDS[title]], tables=[table])


def by_start(found: Judged) -> Section:
    """Value loss by the fewest macro-actions that a start needs."""
    rules = found.spec.rules
    needs = np.array([fewest_actions(rules, state) for state in rules.start_states])
    rows = []
    for (model, size), cells in found.cells.items():
        losses = np.array([cell["value_loss_by_start"] for cell in cells])  # [seeds, starts]
        if losses.size:
            groups = [losses[:, needs == need].mean(axis=1).tolist() for need in np.unique(needs)]
            rows.append([*_heads(found, model, size), *map(mean_cell, groups)])
    columns = [f"{need} ({(needs == need).sum()} starts)" for need in np.unique(needs)]
    caption = "Mean value loss from starts by the fewest macro-actions to a success."
    header = ["world model", "transitions", *columns]
    return Section("Value loss by start", tables=[Table("value_loss_by_start", header, rows, caption)])


def compared(found: Judged) -> Section:
    """Each pair's difference in total variation at the most transitions, and a line on the two best that learned."""
    values = {model: found.scores(model, found.last, "total_variation") for model in found.models}
    learned = [model for model in found.models if not model_entry(model).privileged]
    best = sorted(learned, key=lambda model: iqm(values[model]))[:2]
    pairs = list(itertools.combinations(found.models, 2))
    differences = [difference(values[a], values[b]) for a, b in pairs]
    rows: list[list[str | Cell]] = []
    answers = []
    for pair, each, p in zip(pairs, differences, holm([each.p for each in differences]), strict=True):
        cell = estimate(each, number)
        rows.append([*map(_title, pair), cell, number(p)])
        if set(pair) == set(best):
            first, second = (f"{_title(model)} ({number(iqm(values[model]))})" for model in best)
            shown = "it is better" if p < 0.05 else "no difference is shown"
            verdict = f"difference {cell}, {p_value(p)}, Holm-corrected: {shown}"
            if math.isnan(p):
                verdict = "one seed does not show which is better"
            answers.append(f"Smallest total variation{found.after}: {first}, then {second}; {verdict}.")
    header = ["model", "against", "difference of total variation", "p"]
    caption = f"Total variation of one step{found.after}; Yuen's test over seeds, p by Holm."
    table = Table("differences", header, rows, caption, "one seed says nothing", "Every pair")
    return Section("Against each other", tables=[table], answers=answers)


# Figures -----------------------------------------------------------------------------------------------------------


def _plot(name: str, panels: Panels, xlabel: str, ylabel: str, caption: str) -> Image:
    """Panels by title, each a curve a model, in the color that it has in every figure."""
    models = {model for series in panels.values() for model in series}
    known = registry.world_models()
    colors = {_title(model): figures.color(model, known) for model in models}
    shown = {}
    for title, series in panels.items():
        shown[title] = {_title(model): values for model, values in series.items()}
    return figures.plot(name, lambda: figures.lines(shown, colors, xlabel, ylabel), caption)


def curve(found: Judged) -> Section | None:
    """Two scores by the transitions that models learned from."""
    learning = found.judgement.learning
    if not learning:
        return None
    panels: Panels = {COLUMNS[name]: {model: {} for model in learning} for name in ("total_variation", "value_loss")}
    for name, (model, size) in itertools.product(("total_variation", "value_loss"), found.cells):
        if model in learning:
            panels[COLUMNS[name]][model][f"{size:,}"] = float(np.mean(found.scores(model, size, name)))
    caption = "Means over seeds. Every model learns from the same transitions."
    image = _plot("curve", panels, "transitions", "0 is best", caption)
    return Section("How much data does it need?", images=[image])


def depth(found: Judged) -> Section:
    """Total variation by imagined depth."""
    samples = found.judgement.samples
    truth = prepare(found.judgement, found.folder).rollouts.truth
    noise = np.mean([[sampling_noise_floor(shares(each), samples) for each in steps] for steps in truth], axis=0)
    steps = range(1, 1 + len(noise))
    series = found.means("tv_by_depth", steps, found.last, found.models)
    floor = ", ".join(f"{share:.2f}" for share in noise)
    caption = f"Means over seeds{found.after}. Drawing only {samples} samples adds at most {floor}, by depth."
    image = _plot("depth", {"": series}, "imagined macro-actions", "total variation", caption)
    return Section("How far ahead?", images=[image])


def risk(found: Judged) -> Section | None:
    """Risk against coverage of the models that learned and say how sure they are."""
    learned = [model for model in found.models if not model_entry(model).privileged]
    answered = [100.0 * share for share in COVERAGES]
    panels = {}
    for size in found.judgement.sizes:
        if series := found.means("risk", answered, size, learned):
            panels[f"{size:,} transitions"] = series
    if not panels:
        return None
    caption = "A model that knows its errors has a curve that is low on the left. Means over seeds."
    image = _plot("risk_coverage", panels, "answered, the surest first (%)", "total variation", caption)
    return Section("The errors of the surest answers", images=[image])


# Images ------------------------------------------------------------------------------------------------------------


def _sheet(name: str, caption: str, titles: Sequence[str], real: Rows, imagined: Rows) -> Image:
    """Images below titles, real ones above and imagined ones with whether each may happen."""
    rows = [*real, *((title, [_rgb(each) for each in images], right) for title, images, right in imagined)]
    return Image.of(name, png(transition_sheet(titles, rows)), caption)


def _rgb(image: Pixels) -> Pixels:
    return image if image.ndim == 3 else np.repeat(image[:, :, None], 3, axis=2)


def futures(found: Judged) -> Section | None:
    """One rollout, real and as each model imagines it."""
    if not found.images:
        return None
    names = found.spec.action_names
    one = next(iter(found.images.values()))
    start = one["futures_before"][0]
    titles = ["start", *(f"{step}. {names[action]}" for step, action in enumerate(one["futures_actions"][0], 1))]
    real = [("real", [start, *one["futures_real"][0]], None)]
    imagined = []
    for model, arrays in found.images.items():
        right = [True, *arrays["futures_right"][0].tolist()]
        imagined.append((_title(model), [start, *arrays["futures_imagined"][0]], right))
    caption = "One real start and the same macro-actions, real and as each model imagines them."
    return Section("One future", images=[_sheet("futures", caption, titles, real, imagined)])


def where(found: Judged) -> Section:
    """Total variation by what may make it hard, the worst ten transitions of each model, and those after the end."""
    groups: dict[tuple[str, str], dict[str, list[float]]] = {}
    for model in found.models:
        for cell in found.cells[model, found.last]:
            for kind, each in cell["where"].items():
                for name, value in each.items():
                    groups.setdefault((kind, name), {}).setdefault(model, []).append(value)
    rows: list[list[str | Cell]] = []
    for group, values in groups.items():
        rows.append([*group, *(mean_cell(values.get(model, []), share=True) for model in found.models)])
    header = ["by", "which", *map(_title, found.models)]
    caption = f"Total variation of one step{found.after}; of a coordinate, that of it alone."
    table = Table("where", header, rows, caption, "no such transition")
    images = []
    for model, arrays in found.images.items():
        if not arrays["worst_right"].all():
            caption = f"The ten worst transitions of {_title(model)}."
            images.append(_transitions(found, f"worst_{file_name(model)}", caption, "worst", {"imagined": arrays}))
    ended = {_title(model): arrays for model, arrays in found.images.items() if "after_before" in arrays}
    if ended:  # the thesis' figure 5.9
        caption = "Macro-actions after the end of an episode, which no data contains."
        images.append(_transitions(found, "after_the_end", caption, "after", ended))
    return Section("Where it fails", tables=[table], images=images)


def _transitions(found: Judged, name: str, caption: str, kind: str, models: Mapping[str, Arrays]) -> Image:
    """Transitions of a kind before and after, real and imagined."""
    one = next(iter(models.values()))
    titles = [found.spec.action_names[action] for action in one[f"{kind}_actions"][:, 0]]
    real = [("before", list(one[f"{kind}_before"]), None), ("real", list(one[f"{kind}_real"][:, 0]), None)]
    imagined = []
    for title, arrays in models.items():
        imagined.append((title, list(arrays[f"{kind}_imagined"][:, 0]), arrays[f"{kind}_right"][:, 0].tolist()))
    return _sheet(name, caption, titles, real, imagined)


SECTIONS: tuple[Callable[[Judged], Section | None], ...] = (
    in_short,
    futures,
    risk,
    curve,
    depth,
    *(functools.partial(question, title=title) for title in QUESTIONS),
    by_start,
    where,
    compared,
)
"""The sections of the page, in their order. A new one is a function and a line here."""
