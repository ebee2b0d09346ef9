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
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imagine_bench import registry
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
_TELLING = 0.1  # total variation


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
    def images(self) -> dict[str, dict[str, Any]]:
        """Arrays of the images that are kept, by model."""
        return shown(self.folder, self.judgement)

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
    """Each pair's difference in total variation at the most transitions, and a line on the two best."""
    pairs = list(itertools.combinations(found.models, 2))
    values = {model: found.scores(model, found.last, "total_variation") for model in found.models}
    differences = [difference(values[a], values[b]) for a, b in pairs]
    adjusted = holm([each.p for each in differences])
    rows: list[list[str | Cell]] = []
    answers = []
    learned = [model for model in found.models if not model_entry(model).privileged]
    best = sorted(learned, key=lambda model: iqm(values[model]))[:2]
    for (a, b), each, p in zip(pairs, differences, adjusted, strict=True):
        cell = estimate(each, number)
        rows.append([_title(a), _title(b), cell, number(p)])
        if {a, b} == set(best):
            first, second = (f"{_title(model)} ({number(iqm(values[model]))})" for model in best)
            shown = f"{p_value(p)}, Holm-corrected: {'no difference is shown' if p >= 0.05 else 'it is better'}"
            verdict = "one seed does not show which is better" if math.isnan(p) else f"difference {cell}, {shown}"
            answers.append(f"Smallest total variation{found.after}: {first}, then {second}; {verdict}.")
    header = ["model", "against", "difference of total variation", "p"]
    caption = f"Total variation of one step{found.after}; Yuen's test over seeds, p by Holm."
    table = Table("differences", header, rows, caption, "one seed says nothing", "Every pair")
    return Section("Against each other", tables=[table], answers=answers)


# Figures -----------------------------------------------------------------------------------------------------------


def _draw(axes: Axes, x: Sequence[float], series: Mapping[str, Sequence[float]], **settings: Any) -> None:
    """A line a model, each in the color that it has in every figure."""
    for model, values in series.items():
        color = figures.color(model, registry.world_models())
        figures.curve(axes, dict(zip(x, values, strict=True)), color=color, label=_title(model))
    axes.set(**settings)


def _lines(x: Sequence[float], series: Mapping[str, Sequence[float]], **settings: Any) -> tuple[Figure, Axes]:
    figure, axes = figures.panel()
    _draw(axes, x, series, ylim=(-0.03, 1.05), **settings)
    figures.names_right(figure, axes)
    return figure, axes


def curve(found: Judged) -> Section | None:
    """Two scores by the transitions that models learned from."""
    sizes = found.judgement.sizes

    def draw() -> Figure:
        figure, panels = figures.small_multiples(2, 2, width=4.2, height=3.3)
        names = {"total_variation": "total variation, 1 step", "value_loss": "value loss"}
        for axes, (name, label) in zip(panels, names.items(), strict=True):
            series = {}
            for model in found.judgement.learning:
                series[model] = [float(np.mean(found.scores(model, size, name) or math.nan)) for size in sizes]
            _draw(axes, sizes, series, ylabel=label)
            figures.log_axis(axes, sizes, "transitions of the same data")
        figure.legend(*panels[0].get_legend_handles_labels(), ncols=4, loc="outside lower center")
        return figure

    if not found.judgement.learning:
        return None
    caption = "Total variation and value loss by transitions; mean over seeds. Every model learns from the same ones."
    return Section("How much data does it need?", images=[figures.plot("curve", draw, caption)])


def depth(found: Judged) -> Section:
    """Total variation by imagined depth."""
    samples = found.judgement.samples
    truth = prepare(found.judgement, found.folder).rollouts.truth
    noise = [[sampling_noise_floor(shares(outcomes), samples) for outcomes in steps] for steps in truth]
    series = {}
    for model in found.models:
        series[model] = np.mean([cell["tv_by_depth"] for cell in found.cells[model, found.last]], axis=0).tolist()
    steps = range(1, 1 + len(noise[0]))

    def draw() -> Figure:
        figure, axes = _lines(steps, series, xlabel="imagined macro-actions", ylabel="total variation")
        axes.plot(steps, np.mean(noise, axis=0), ":", color=figures.GRAY)
        return figure

    caption = (
        f"Total variation to the exact distribution by depth{found.after}; dotted: the part that comes from drawing "
        f"only {samples} samples."
    )
    return Section("How far ahead?", images=[figures.plot("depth", draw, caption)])


def risk(found: Judged) -> Section | None:
    """Risk against coverage, where more than one model errs in a tenth of all; nothing where none is uncertain."""
    risks = {size: _risks(found, size) for size in found.judgement.sizes}
    telling = [size for size, each in risks.items() if sum(curve[-1] > _TELLING for curve in each.values()) > 1]
    known = [size for size, each in risks.items() if each]
    if not known:
        return None
    size = telling[-1] if telling else known[0]
    percentages = [100.0 * share for share in COVERAGES]
    labels = {"xlabel": "questions answered, the surest first (%)", "ylabel": "total variation of those answered"}
    caption = (
        "A model that knows its errors has a curve that is low on the left. Models without an uncertainty are not "
        f"here. Mean over seeds{f' after {size:,} transitions' if found.judgement.learning else ''}."
    )
    image = figures.plot("risk_coverage", lambda: _lines(percentages, risks[size], **labels)[0], caption)
    return Section("The errors of the surest answers", images=[image])


def _risks(found: Judged, size: int) -> dict[str, list[float]]:
    """Mean risk by coverage of each model that learned and says how sure it is."""
    curves = {}
    for model in found.models:
        own = [cell["risk"] for cell in found.cells.get((model, size), []) if cell["risk"]]
        if own and not model_entry(model).privileged:
            curves[model] = np.mean(own, axis=0).tolist()
    return curves


# Images ------------------------------------------------------------------------------------------------------------


def _sheet(name: str, caption: str, titles: Sequence[str], rows: Sequence[tuple[str, Any, Any]]) -> Image:
    """Rows of images below titles: a name, the images, and whether each may happen (None: it is real)."""
    return Image.of(name, png(transition_sheet(titles, list(rows))), caption)


def _rgb(images: Any) -> list[Any]:
    return [each if each.ndim == 3 else np.repeat(each[:, :, None], 3, axis=2) for each in images]


def futures(found: Judged) -> Section | None:
    """One rollout, real and as each model imagines it."""
    if not found.images:
        return None
    names = found.spec.action_names
    one = next(iter(found.images.values()))
    start = one["futures_before"][0]
    titles = ["start", *(f"{step}. {names[action]}" for step, action in enumerate(one["futures_actions"][0], 1))]
    rows: list[tuple[str, Any, Any]] = [("real", [start, *one["futures_real"][0]], None)]
    for model, arrays in found.images.items():
        imagined = [start, *_rgb(arrays["futures_imagined"][0])]
        rows.append((_title(model), imagined, [True, *arrays["futures_right"][0].tolist()]))
    caption = "One real start and the same macro-actions, real and as each model imagines them."
    return Section("One future", images=[_sheet("futures", caption, titles, rows)])


def where(found: Judged) -> Section:
    """Total variation by what may make it hard, the worst ten transitions of each model, and those after the end."""
    groups: dict[tuple[str, str], dict[str, list[float]]] = {}
    for model in found.models:
        for cell in found.cells[model, found.last]:
            for kind, each in cell["where"].items():
                for name, value in each.items():
                    groups.setdefault((kind, name), {}).setdefault(model, []).append(value)
    rows: list[list[str | Cell]] = [
        [kind, name, *(mean_cell(values.get(model, []), share=True) for model in found.models)]
        for (kind, name), values in groups.items()
    ]
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


def _transitions(found: Judged, name: str, caption: str, kind: str, imagined: Mapping[str, dict[str, Any]]) -> Image:
    """Transitions of a kind before and after, real and imagined."""
    one = next(iter(imagined.values()))
    titles = [found.spec.action_names[action] for action in one[f"{kind}_actions"][:, 0]]
    rows: list[tuple[str, Any, Any]] = [("before", list(one[f"{kind}_before"]), None)]
    rows.append(("real", list(one[f"{kind}_real"][:, 0]), None))
    for title, arrays in imagined.items():
        rows.append((title, _rgb(arrays[f"{kind}_imagined"][:, 0]), arrays[f"{kind}_right"][:, 0].tolist()))
    return _sheet(name, caption, titles, rows)


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
