"""What a judgement found: a table, futures beside the truth, what models know of their errors, and where those are."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imagine_bench import registry
from imagine_bench.interfaces import TaskSpec
from imagine_bench.judge.filmstrips import png, transition_sheet
from imagine_bench.judge.models.change import FALSE_ALARMS, LENGTH, SLIP
from imagine_bench.judge.models.outcomes import sampling_noise_floor
from imagine_bench.judge.models.scores import COVERAGES
from imagine_bench.judge.models.study import Judgement, kept, prepare, shown
from imagine_bench.judge.models.trained import model_entry, runs_of
from imagine_bench.judge.models.truth import shares
from imagine_bench.registry.entries import file_name
from imagine_bench.report.figures import image
from imagine_bench.report.page import aligned, flat, write_page
from imagine_bench.report.tables import DASH, Image, Page, Section, Table, number
from imagine_bench.report.tables import Cell as TableCell
from imagine_bench.rules import fewest_actions
from imagine_bench.statistics import difference, holm, interval, iqm
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
_COLORS = ("#8c8c8c", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b8860b", "#56b4e9", "#661100", "#000000")
_SHARES = {
    *("total_variation", "tv_3", "tv_5", "tv_10", "after_the_end", "nothing"),
    *("outcome_ece", "reward_ece", "end_error", "end_ece"),
    *("filter_keeps", "filter_error", "best_skill", "counterfactual"),
    *(name for name in COLUMNS if name.startswith("auroc")),
}
_WHY_DASH = "not offered by the model, or nothing to tell apart"
_WHOLE = 1_000  # from here on no decimals are shown
_TELLING = 0.1  # total variation
Cells = Mapping[tuple[str, int], Sequence[dict[str, Any]]]
"""Kept cells, one a seed, by model and transitions."""
Pictures = Mapping[str, dict[str, Any]]
"""What :func:`.judge.models.study.shown` gives."""


def judgement_report(folder: Path, judgement: Judgement) -> str:
    """Write ``folder / "report"`` and return the short table and where everything lies."""
    cells = by_model(kept(folder, judgement))
    page = write_page(folder / "report", _page(folder, judgement, cells))
    head = ["world model", "transitions", *(COLUMNS[name] for name in SHORT)]
    rows = [[title, size, *map(str, row)] for title, size, *row in _rows(judgement, cells, SHORT, judgement.sizes)]
    return "\n".join([*aligned([head, *rows]), "", f"Report: {page}"])


def by_model(found: Sequence[dict[str, Any]]) -> Cells:
    """Cells by model and transitions."""
    grouped: dict[tuple[str, int], list[dict[str, Any]]] = {}
    for cell in found:
        grouped.setdefault((cell["model"], cell["transitions"]), []).append(cell)
    return grouped


def scores(cells: Sequence[dict[str, Any]], name: str) -> list[float]:
    """A score of each cell, by name; ``tv_5`` is the total variation at depth 5. NaN where there is none."""
    digits = 3 if name.endswith("_s") else 9  # what takes less than a millisecond takes nothing
    values = [cell["tv_by_depth"][int(name[3:]) - 1] if name.startswith("tv_") else cell[name] for cell in cells]
    return [math.nan if value is None else round(float(value), digits) for value in values]


def mean_cell(values: Sequence[float], *, share: bool = False) -> TableCell:
    """Interquartile mean over seeds with its 95 % interval, of a ``share`` in [0, 1]; a dash for no number."""
    there = [value for value in values if not math.isnan(value)]
    if not there:
        return TableCell(text=DASH)
    low, high = interval(there, share=share)
    shown = "" if math.isnan(low) or low == high else f"[{number(low)}, {number(high)}]"
    value = iqm(there)
    return TableCell(text=f"{value:,.0f}" if value >= _WHOLE else number(value), interval=shown)


def _size(model: str, size: int) -> str:
    """The transitions that it learned from here; a trained agent's own are its bench's to say."""
    return DASH if runs_of(model) else f"{size:,}"


def _title(model: str) -> str:
    return model_entry(model).title


def _after(judgement: Judgement, size: int) -> str:
    """Words for what models had learned from; none where all are trained agents, which learned in their benches."""
    return f" after {size:,} transitions" if judgement.learning else ""


def _rows(judgement: Judgement, cells: Cells, names: Sequence[str], sizes: Sequence[int]) -> list[list[Any]]:
    return [
        [
            _title(model),
            _size(model, size),
            *(mean_cell(scores(cells[model, size], name), share=name in _SHARES) for name in names),
        ]
        for model, size in itertools.product(judgement.models, sizes)
        if (model, size) in cells
    ]


def _page(folder: Path, judgement: Judgement, cells: Cells) -> Page:
    spec = registry.task(judgement.task)
    made = read_json(folder / "judgement.json", "a judgement")
    pictures, last = shown(folder, judgement), judgement.sizes[-1:]
    largest = [model for model in judgement.models if (model, *last) in cells]
    short = Table(
        name="short", header=["world model", "transitions", *(COLUMNS[name] for name in SHORT)], why_dash=_WHY_DASH,
        rows=_rows(judgement, cells, SHORT, last),
        caption=f"Interquartile means over {_seeds(judgement)}, with 95 % intervals. 0 is best in every error; value "
        "loss is in units of reward.",
    )  # fmt: skip
    images = [*_futures(judgement, pictures), *_risk_images(judgement, cells, largest)]
    by_question = {title: _question_section(title, judgement, cells) for title in QUESTIONS}
    outcomes, rewards, costs, *others = by_question.values()
    sections = [
        Section(title="In short", words=[_reader_words(folder)], tables=[short]),
        Section(title="One future, and the errors of the surest answers", images=images),
        *(
            [Section(title="How much data does it need?", images=[_curve_image(judgement, cells)])]
            if judgement.learning
            else []
        ),
        replace(outcomes, images=[_depth_image(folder, judgement, cells, largest)]),
        rewards,
        replace(costs, tables=[*costs.tables, _by_start(spec, judgement, cells)]),
        _where_section(spec, judgement, cells, largest, pictures),
        *others,
        Section(title="Against each other", tables=[_compared(judgement, cells, largest)]),
    ]
    data = f"Data: {judgement.policy} policy, kinematic" if judgement.learning else "Trained agents"
    return Page(
        title=f"{spec.title}: world models against the exact truth",
        subtitle=f"{data} · appearance “{judgement.appearance}” · {judgement.samples} futures a question",
        question="Which model imagines what really happens, how sure is it, and what do its mistakes cost?",
        answers=_answers(judgement, cells, largest), sections=sections,
        facts=flat("", made), settings={}, protocol=flat("", dataclasses.asdict(judgement)), recordings=[],
        files={"scores.csv": _csv(cells)},
    )  # fmt: skip


def _seeds(judgement: Judgement) -> str:
    """What an interval is over."""
    kinds = [f"{len(judgement.seeds)} seeds of data and model"] if judgement.learning else []
    if len(judgement.learning) < len(judgement.models):
        kinds.append("the runs of each trained agent")
    return " or ".join(kinds)


def _reader_words(folder: Path) -> str:
    errors = read_json(folder / "reader.json", "a reader's errors")
    return (
        f"The reader takes {errors['misread']:.2%} of fresh real frames for another macrostate and refuses "
        f"{errors['refused']:.2%}; it reads {errors['blends_read']:.1%} of blends of two frames, "
        f"{errors['noise_read']:.1%} of noise, and {'some' if errors['gray_read'] + errors['black_read'] else 'no'} "
        "fog as something."
    )


def _question_section(title: str, judgement: Judgement, cells: Cells) -> Section:
    """The scores that answer one question, after every number of transitions."""
    names = tuple(QUESTIONS[title])
    table = Table(
        name=title.lower().strip("?").replace(" ", "_").replace(",", ""), why_dash=_WHY_DASH,
        header=["world model", "transitions", *QUESTIONS[title].values()],
        rows=_rows(judgement, cells, names, judgement.sizes), folded="After every number of transitions",
    )  # fmt: skip
    return Section(title=title, words=[_WORDS[title]], tables=[table])


def _by_start(spec: TaskSpec, judgement: Judgement, cells: Cells) -> Table:
    """Value loss by the fewest macro-actions that a start needs, after every number of transitions."""
    needs = [fewest_actions(spec.rules, state) for state in spec.rules.start_states]
    rows: list[list[str | TableCell]] = []
    for (model, size), each in cells.items():
        losses = np.array([cell["value_loss_by_start"] for cell in each])  # [seeds, starts]
        if losses.size:
            groups = [losses[:, [need == n for need in needs]].mean(axis=1).tolist() for n in sorted(set(needs))]
            rows.append([_title(model), _size(model, size), *map(mean_cell, groups)])
    return Table(
        name="value_loss_by_start", folded="By start", rows=rows,
        header=["world model", "transitions", *(f"{n} ({needs.count(n)} starts)" for n in sorted(set(needs)))],
        caption="Mean value loss from starts by the fewest macro-actions to a success.",
    )  # fmt: skip


def _answers(judgement: Judgement, cells: Cells, models: Sequence[str]) -> list[str]:
    """The best model that is given no rules, at the largest size."""
    last = judgement.sizes[-1]
    learned = [model for model in models if not model_entry(model).privileged]
    if not learned:
        return []
    found = []
    for name, words in (("total_variation", "total variation"), ("value_loss", "value loss")):
        scored = {
            model: iqm(values) for model in learned if not np.isnan(values := scores(cells[model, last], name)).any()
        }
        if scored:
            best = min(scored, key=lambda model: scored[model])
            when = "" if runs_of(best) else _after(judgement, last)
            found.append(f"{_title(best)} has the smallest {words}{when}: {number(scored[best])}.")
    return found


def _csv(cells: Cells) -> str:
    names = ["model", "transitions", "seed", *COLUMNS]
    rows = [
        [model, size, cell["seed"], *(_plain(scores([cell], name)[0]) for name in COLUMNS)]
        for (model, size), each in cells.items()
        for cell in each
    ]
    return csv_text([names, *rows])


def _plain(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.6g}"


def _compared(judgement: Judgement, cells: Cells, models: Sequence[str]) -> Table:
    """Each pair's difference in total variation at the largest size."""
    last = judgement.sizes[-1]
    pairs = list(itertools.combinations(models, 2))
    found = [difference(*(scores(cells[model, last], "total_variation") for model in pair)) for pair in pairs]
    adjusted = holm([one.p for one in found])
    rows: list[list[str | TableCell]] = [
        [_title(a), _title(b), TableCell(text=number(one.value), interval=f"[{number(one.low)}, {number(one.high)}]"),
         number(p)]
        for (a, b), one, p in zip(pairs, found, adjusted, strict=True)
    ]  # fmt: skip
    return Table(
        name="differences", header=["model", "against", "difference of total variation", "p"], rows=rows,
        caption=f"Total variation of one step{_after(judgement, last)}; Yuen's test over seeds, p by Holm.",
        why_dash="one seed says nothing", folded="Every pair",
    )  # fmt: skip


def _lines(x: Sequence[float], series: Mapping[str, Sequence[float]], xlabel: str, ylabel: str) -> Figure:
    figure = Figure(figsize=(9.2, 4.2), layout="constrained")
    axes = figure.add_subplot()
    _draw(axes, series, x, ylim=(-0.03, 1.05), xlabel=xlabel, ylabel=ylabel)
    axes.legend(fontsize=9, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _draw(axes: Axes, series: Mapping[str, Sequence[float]], x: Sequence[float], **settings: Any) -> None:
    """A line a model, each in the color that it has in every figure."""
    places = {name: place for place, name in enumerate(registry.world_models())}
    for model, values in series.items():
        color = _COLORS[places.get(model, crc32(model.encode())) % len(_COLORS)]
        axes.plot(x, values, color=color, marker="o", markersize=3.5, label=_title(model))
    axes.set(**settings)


def _curve_image(judgement: Judgement, cells: Cells) -> Image:
    """Two scores by the transitions that models learned from."""
    shown_, sizes = {"total_variation": "total variation, 1 step", "value_loss": "value loss"}, list(judgement.sizes)

    def draw() -> Figure:
        figure = Figure(figsize=(9.2, 4.0), layout="constrained")
        for axes, (name, label) in zip(figure.subplots(1, 2), shown_.items(), strict=True):
            series = {
                model: [float(np.mean(scores(cells[model, size], name))) if (model, size) in cells else math.nan
                        for size in sizes]
                for model in judgement.learning
            }  # fmt: skip
            _draw(axes, series, sizes, xscale="log", xlabel="transitions of the same data", ylabel=label)
            axes.set_xticks(sizes, [f"{size:,}" for size in sizes])
            axes.minorticks_off()
        figure.legend(*axes.get_legend_handles_labels(), fontsize=9, ncols=4, loc="outside lower center")
        return figure

    return image(
        "curve", draw, svg=True, alt="Total variation and value loss by the number of transitions learned from",
        caption="Mean over seeds. Every model learns from the same transitions.",
    )  # fmt: skip


def _risk_images(judgement: Judgement, cells: Cells, models: Sequence[str]) -> list[Image]:
    """One figure, or none where no model is uncertain of anything."""
    size = _telling_size(judgement, cells, models)
    series = _risks(cells, models, size)
    shares = [100.0 * share for share in COVERAGES]
    if not series:
        return []
    when = f"{_after(judgement, size)}, where most of them still err" if judgement.learning else ""
    one = image(
        "risk_coverage",
        lambda: _lines(shares, series, "questions answered, the surest first (%)", "total variation of those answered"),
        alt="Risk against coverage of each model that offers an epistemic uncertainty", svg=True,
        caption="A model that knows what it does not know has a curve that is low on the left. Models without an "
        f"uncertainty are not here. Mean over seeds{when}.",
    )  # fmt: skip
    return [one]


def _risks(cells: Cells, models: Sequence[str], size: int) -> dict[str, list[float]]:
    """Mean risk by coverage of each model that learned and says how sure it is."""
    own = {model: cells.get((model, size), ()) for model in models if not model_entry(model).privileged}
    curves = {model: [cell["risk"] for cell in each if cell["risk"]] for model, each in own.items()}
    return {model: np.mean(each, axis=0).tolist() for model, each in curves.items() if each}


def _telling_size(judgement: Judgement, cells: Cells, models: Sequence[str]) -> int:
    """The most transitions after which more than one model is wrong in a tenth of all; else the fewest."""
    for size in judgement.sizes[::-1]:
        if sum(curve[-1] > _TELLING for curve in _risks(cells, models, size).values()) > 1:
            return size
    return next((size for size in judgement.sizes if _risks(cells, models, size)), judgement.sizes[0])


def _depth_image(folder: Path, judgement: Judgement, cells: Cells, models: Sequence[str]) -> Image:
    last, truth = judgement.sizes[-1], prepare(judgement, folder).rollouts.truth
    floor = [[sampling_noise_floor(shares(outcomes), judgement.samples) for outcomes in steps] for steps in truth]
    series = {model: np.mean([cell["tv_by_depth"] for cell in cells[model, last]], axis=0).tolist() for model in models}
    steps = range(1, 1 + len(next(iter(series.values()), [])))

    def draw() -> Figure:
        figure = _lines(list(steps), series, "imagined macro-actions", "total variation")
        figure.axes[0].plot(range(1, 1 + len(floor[0])), np.mean(floor, axis=0), ":", color=_COLORS[0], linewidth=1.2)
        return figure

    return image(
        "depth", draw, svg=True, alt="Total variation to the exact distribution by imagined depth",
        caption=f"Total variation to the exact distribution by depth{_after(judgement, last)}; dotted: what "
        f"{judgement.samples} samples of the exact distribution itself would show.",
    )  # fmt: skip


def _futures(judgement: Judgement, found: Pictures) -> list[Image]:
    """One rollout, real and as each model imagines it."""
    names = registry.task(judgement.task).action_names
    if not found:
        return []
    one = next(iter(found.values()))
    titles = ["start", *(f"{step}. {names[action]}" for step, action in enumerate(one["futures_actions"][0], start=1))]
    start = one["futures_before"][0]
    rows: list[tuple[str, Any, Any]] = [("real", [start, *one["futures_real"][0]], None)]
    for model, arrays in found.items():
        rows.append((_title(model), [start, *map(_rgb, arrays["futures_imagined"][0])],
                     [True, *arrays["futures_right"][0].tolist()]))  # fmt: skip
    caption = "One real start and the same macro-actions, real and as each model imagines them."
    return [_sheet("futures", titles, rows, "One future, real and imagined by every model", caption)]


def _after_the_end(spec: TaskSpec, found: Pictures) -> list[Image]:
    """A few transitions that no training contains, real and as each model imagines them (thesis' figure 5.9)."""
    there = {model: arrays for model, arrays in found.items() if "after_before" in arrays}
    if not there:
        return []
    one = next(iter(there.values()))
    rows: list[tuple[str, Any, Any]] = [
        ("before", list(one["after_before"]), None), ("real", list(one["after_real"][:, 0]), None)
    ]  # fmt: skip
    for model, arrays in there.items():
        rows.append(
            (_title(model), list(map(_rgb, arrays["after_imagined"][:, 0])), arrays["after_right"][:, 0].tolist())
        )
    titles = [spec.action_names[action] for action in one["after_actions"][:, 0]]
    caption = "Macro-actions after the end of an episode, which no data contains."
    return [_sheet("after_the_end", titles, rows, "Transitions after the end, real and imagined", caption)]


def _sheet(name: str, titles: Sequence[str], rows: list[tuple[str, Any, Any]], alt: str, caption: str) -> Image:
    return Image.of(png(transition_sheet(titles, rows)), name=name, alt=alt, caption=caption)


def _where_section(
    spec: TaskSpec, judgement: Judgement, cells: Cells, models: Sequence[str], pictures: Pictures
) -> Section:
    """Total variation by what may make it hard, and the worst ten transitions of each model."""
    last = judgement.sizes[-1]
    groups: dict[tuple[str, str], dict[str, TableCell]] = {}
    for model in models:
        wheres = [cell["where"] for cell in cells[model, last]]
        for kind, name in {(kind, name): None for where in wheres for kind, each in where.items() for name in each}:
            values = [where[kind][name] for where in wheres if name in where[kind]]
            groups.setdefault((kind, name), {})[model] = mean_cell(values, share=True)
    rows: list[list[str | TableCell]] = [
        [kind, name, *(found.get(model, DASH) for model in models)] for (kind, name), found in groups.items()
    ]
    table = Table(
        name="where", header=["by", "which", *map(_title, models)], rows=rows, why_dash="no such transition",
        caption=f"Total variation of one step{_after(judgement, last)}; of a coordinate, that of it alone.",
    )  # fmt: skip
    images = []
    for model, arrays in pictures.items():
        if not arrays["worst_right"].all():
            titles = [spec.action_names[action] for action in arrays["worst_actions"][:, 0]]
            strips: list[tuple[str, Any, Any]] = [
                ("before", list(arrays["worst_before"]), None), ("real", list(arrays["worst_real"][:, 0]), None),
                ("imagined", list(map(_rgb, arrays["worst_imagined"][:, 0])), arrays["worst_right"][:, 0].tolist()),
            ]  # fmt: skip
            caption = f"The ten worst transitions of {_title(model)}."
            images.append(_sheet(f"worst_{file_name(model)}", titles, strips, f"Worst of {_title(model)}", caption))
    return Section(title="Where it fails", tables=[table], images=[*images, *_after_the_end(spec, pictures)])


def _rgb(picture: Any) -> Any:
    return picture if picture.ndim == 3 else np.repeat(picture[:, :, None], 3, axis=2)
