"""The report of a judgement: scores by question, futures beside the truth, and how well models know their errors."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path

import numpy as np

from imagine_bench import registry
from imagine_bench.appearance import appearance_typed
from imagine_bench.arrays import Arrays, Pixels
from imagine_bench.exact.changed_rules import SLIP
from imagine_bench.interfaces import TaskSpec
from imagine_bench.judge.change import FALSE_ALARMS, LENGTH
from imagine_bench.judge.judgement import Judgement, kept, shown
from imagine_bench.judge.models import model_entry, runs_of
from imagine_bench.judge.policies.acceptance import ALPHA
from imagine_bench.judge.scores import CellScores
from imagine_bench.recording.filmstrips import TileRow, png, transition_sheet
from imagine_bench.registry.entries import file_name
from imagine_bench.report.levels import LEVELS, claims_table, film_image
from imagine_bench.report.page import (
    DASH,
    Image,
    Page,
    Section,
    Table,
    estimate,
    number,
    over_seeds,
)
from imagine_bench.report.worlds import worlds_csv, worlds_section
from imagine_bench.statistics import can_show, difference, holm, iqm
from imagine_bench.store import encoders
from imagine_bench.store.files import read_json, table_text

QUESTIONS = {
    "Which outcomes, how likely?": {
        "total_variation": "total variation, 1 step", "tv_3": "3 steps", "tv_5": "5 steps", "tv_10": "10 steps",
        "perfect_sampler": "perfect sampler's, 1 step", "perfect_10": "perfect sampler's, 10",
        "unbiased": "unbiased Brier, 1 step", "unbiased_10": "unbiased Brier, 10",
        "after_the_end": "after the end", "missed": "missed outcomes",
        "hallucinated": "hallucinated outcomes", "unreadable": "unreadable images",
        "outcome_ece": "calibration error", "outcome_brier": "Brier",
    },
    "Which rewards and ends?": {
        "reward_error": "reward error", "reward_ece": "reward calibration", "reward_brier": "reward Brier",
        "end_error": "end error", "end_ece": "end calibration", "end_brier": "end Brier",
    },
    "What do mistakes cost?": {
        "value_loss": "value loss", "worst_value_loss": "from the worst start",
        "value_loss_ruled": "value loss, rules' rewards", "regret": "regret of 1 of 5",
        "regret_ruled": "regret, rules' rewards",
    },
    "Does it know?": {
        "auroc_wrong": "AUROC, wrong", "auroc_never": "never seen", "auroc_either": "either",
        "auroc_after_the_end": "after the end", "auroc_noisy": "aleatoric, noisy", "auroc_several": "modal, several",
        "filter_keeps": "its filter keeps",
        "filter_error": "error of that", "filter_skill": "skill of its filter", "best_skill": "of the best threshold",
        "value_of_abstaining": "value of abstaining", "value_of_filter": "value of its filter",
        "risk_coverage": "risk–coverage area",
    },
    "Does a guarantee hold?": {
        "conformal_accepts": "accepted", "conformal_wrong_on_data": "accepted though wrong, on its data",
        "conformal_wrong_rare": "where its data is rare", "conformal_wrong_policies": "under other policies",
        "conformal_wrong_worst_policy": "under the worst policy",
    },
    "Does it notice?": {
        "notice_slip": "transitions until a slip", "notice_coupling": "until a coupling",
        "counterfactual": "counterfactuals wrong",
    },
    "Which policies does it overrate?": {
        "policy_r": "policies, r", "policy_tau": "policies, τ", "policy_error": "policies, error", "lift": "lift",
        "lift_trained": "lift of training", "exploit": "exploit", "exploit_bound": "exploit, at most",
        "fidelity": "fidelity", "policy_r_ruled": "r, rules' rewards", "policy_tau_ruled": "τ, rules' rewards",
        "policy_error_ruled": "error, rules' rewards", "lift_ruled": "lift, rules' rewards",
        "lift_trained_ruled": "lift of training, rules' rewards",
        "exploit_ruled": "exploit, rules' rewards", "exploit_bound_ruled": "at most, rules' rewards",
    },
    "What does it cost?": {
        "fit_s": "CPU s to fit", "imagine_s_per_1000": "CPU s, 1,000 steps", "parameters": "parameters",
        "encoder_frames": "frames beforehand",
    },
}  # fmt: skip
"""Scores by question: the name of a column of theirs."""
COLUMNS = {name: words for columns in QUESTIONS.values() for name, words in columns.items()}
_WORDS = {
    "Which outcomes, how likely?": "Total variation is the distance of the imagined from the exact distribution of "
    "macrostates: 0 for equal ones, 1 for two that share no macrostate. A model that draws futures instead of giving "
    "probabilities is above 0 even if it is perfect; the columns “perfect sampler's” say how far, for as many futures, "
    "and hold 0 for a model that gives probabilities. The unbiased Brier score is free of that: the sum of squared "
    "differences of probabilities, less the mean share of sampling: 0 is perfect, 2 the worst, and a perfect "
    "sampler may be a little below 0. Compare a model that draws with one that gives probabilities by this score only; "
    "missed and hallucinated outcomes, calibration error and Brier score hold the sampling, too. “After the end” is "
    "the total variation of macro-actions after an episode has ended, which no data contains. Missed and hallucinated "
    "outcomes are counted per transition. “Unreadable images” is their share: the reader recognizes nothing in them.",
    "Which rewards and ends?": "Error of the expected reward, in units of reward, and of the probability of the end. "
    "For calibration and Brier score a reward counts as the nearest that the rules give.",
    "What do mistakes cost?": "Value loss is V* - V: the return of the best policy from a start, less that of the "
    "policy that is optimal in the model; the mean over starts, in units of reward. Regret: the model ranks five "
    "sequences of macro-actions from a start, and regret is the exact return of the best less that of the one ranked "
    "first. Both use the rewards and ends that the model itself predicts, and are a dash where it predicts none. The "
    "columns “rules' rewards” take rewards and ends from the rules, for the macrostates that the model imagines: they "
    "judge all models alike. (Regret has a dash there if a model gives probabilities of several images, because it "
    "does not say which image follows which.)",
    "Does it know?": "AUROC of the epistemic uncertainty for transitions imagined wrongly, never seen in the data, or "
    "either, and for those after the end; of the aleatoric for random ones; of the modal for several outcomes. Skill: "
    "the share of wrong ones that a filter discards, less that of right ones; the best threshold of the epistemic "
    "uncertainty is chosen with the truth, and a filter may read more. Value: reward a start that planning gains "
    "without the macro-actions it knows least of (the best share, chosen with the truth), and without those that its "
    "own filter discards. Risk–coverage area: the share of wrong ones among the k most certain, the mean over all k.",
    "Does a guarantee hold?": f"A transition is accepted if its epistemic uncertainty is below a threshold that is "
    f"chosen on transitions from the data's distribution, so that at most {ALPHA:.0%} are accepted though wrong, in "
    "the mean (conformal risk control). The true shares are enumerated: on the data's distribution, for which this "
    "is proved; for every macro-action in the quarter of the macrostates that the data's policy reaches least; and "
    "for the transitions of about 40 other policies, in the mean and for the worst. For them there is no guarantee.",
    "Does it notice?": f"Random transitions until a detector of surprise says that every macro-action slips with "
    f"probability {SLIP}, or that one also has another's effect, at false alarms in {FALSE_ALARMS:.0%} of "
    f"unchanged streams of {LENGTH}; {LENGTH}: never. Counterfactuals: its imagination of two macro-actions with the "
    "same draws that cannot both be.",
    "Which policies does it overrate?": "The expected returns of about 40 policies (random, optimal, optimal for a "
    "wrong rule, trained by Q-learning, adversarial) are enumerated in the model and in the truth. r and τ are "
    "Pearson's and Kendall's correlations of the two, 1 is best; the error is the mean absolute difference. They are a "
    "dash where all policies are worth the same in the model. Lift: the true return of the plan that is optimal in the "
    "model, less that of the plan that is optimal in a table that counts the same transitions, and knows their "
    "macrostates; above 0 the model is of use. Lift of training: the same of agents that learn by Q-learning in the "
    "model alone, and from that table alone. Exploit: how far the model overrates the policy that it overrates most, "
    "found by a search from many starts, or, below 0, that it underrates all; no policy is overrated by more than “at "
    "most”, which is proved. Fidelity: the part of the optimal policy's gain over random macro-actions that "
    "is left if it sees the model's frames instead of real ones, after the first; chance in the world and in the model "
    "is independent. All returns are means over starts, in units of reward. Only the model's own futures are sampled, "
    "and nothing of the truth.",
    "What does it cost?": "CPU seconds are those of one core: of fitting, and of imagining 1,000 macro-actions. Frames "
    "beforehand are those on which the model's encoder had been trained before.",
}
_MAIN = (
    "total_variation",
    "perfect_sampler",
    "unbiased",
    "unreadable",
    "value_loss",
    "policy_tau",
    "lift",
    "exploit",
    "auroc_wrong",
    "counterfactual",
    "fit_s",
)
SHORT = {name: COLUMNS[name] for name in _MAIN}
_SHARES = {
    "total_variation",
    "tv_3",
    "tv_5",
    "tv_10",
    "perfect_sampler",
    "perfect_10",
    "after_the_end",
    "unreadable",
    "outcome_ece",
    "reward_ece",
    "end_error",
    "end_ece",
    "filter_keeps",
    "filter_error",
    "best_skill",
    "counterfactual",
    *(name for name in COLUMNS if name.startswith(("auroc", "conformal"))),
    "risk_coverage",
}
_MOST_SCORES = 8
"""Scores in one table: more do not fit a page of 1,200 pixels."""
_WHY_DASH = "not offered by the model, nothing to tell apart, or judged before this score existed"
_BY_DEPTH = {"tv": "tv_by_depth", "perfect": "perfect_by_depth", "unbiased": "unbiased_by_depth"}


@dataclass(frozen=True)
class Judged:
    """A judgement and its kept results."""

    folder: Path
    judgement: Judgement
    spec: TaskSpec  # the task
    cells: dict[tuple[str, int], list[CellScores]]  # one a seed, by model and transitions

    @property
    def last(self) -> dict[str, list[CellScores]]:
        """The cells at the most transitions, by model."""
        return {model: cells for (model, size), cells in self.cells.items() if size == self.judgement.sizes[-1]}

    @property
    def after(self) -> str:
        """The data that models had learned from; nothing where all are trained agents, which learned in their
        benches.
        """
        judgement = self.judgement
        if not judgement.learning:
            return ""
        fitted = f" after {judgement.sizes[-1]:,} transitions"
        return fitted + " (of trained agents, after their benches)" * (len(judgement.learning) < len(judgement.models))


def judged(folder: Path, judgement: Judgement) -> Judged:
    """A judgement with the cells that are kept in its folder. Raises ArtefactError: a file is damaged."""
    cells: dict[tuple[str, int], list[CellScores]] = {}
    for cell in kept(folder, judgement):
        cells.setdefault((cell["model"], cell["transitions"]), []).append(cell)
    return Judged(folder, judgement, registry.task(judgement.task), cells)


def judgement_page(found: Judged) -> Page:
    """The page of a judgement."""
    judgement = found.judgement
    data = f"Data: {judgement.policy} policy, kinematic" if judgement.learning else "Trained agents"
    sections = [section for make in SECTIONS if (section := make(found)) is not None]
    looks = appearance_typed(judgement.appearance)
    return Page(
        title=f"{found.spec.title}: world models against the exact truth",
        subtitle=f"{data} · appearance “{looks}” · {judgement.samples} futures a question",
        question="Which model imagines what really happens, how sure is it, and what do its mistakes cost?",
        table=sections[0].tables[0],
        more=[table for section in sections for table in section.tables if table.name == "worlds"],
        sections=sections,
        files={"scores.csv": _csv(found), "worlds.csv": worlds_csv(found.cells)},
        facts=read_json(found.folder / "judgement.json", "a judgement"),
    )


def _csv(found: Judged) -> str:
    rows: list[dict[str, float | str]] = []
    for cell in itertools.chain.from_iterable(found.cells.values()):
        rows.append({name: cell[name] for name in ("model", "transitions", "seed")})
        rows[-1]["privileged"] = str(model_entry(cell["model"]).privileged).lower()
        for name in COLUMNS:
            value = score(cell, name)
            rows[-1][name] = "" if math.isnan(value) else f"{value:.6g}"
    return table_text(rows)


# Scores ------------------------------------------------------------------------------------------------------------


def score(cell: CellScores, name: str) -> float:
    """A score of a cell; ``tv_5`` is the total variation at depth 5. NaN where there is none."""
    kind, _, depth = name.rpartition("_")
    if kind in _BY_DEPTH and depth.isdigit():
        values = cell.get(_BY_DEPTH[kind])
        value = None if values is None else values[int(depth) - 1]
    else:
        value = cell.get(name)
    digits = 3 if name.endswith("_s") else 9  # a time of less than a millisecond is none
    return math.nan if value is None else round(float(value), digits)


def _number(value: float) -> str:
    return f"{value:,.0f}" if value >= 1_000 else number(value)


def _title(model: str) -> str:
    return model_entry(model).label


def _scores(found: Judged, table: str, columns: Mapping[str, str]) -> Table:
    """A row a model and number of transitions, a column a score over seeds; ``columns`` are their titles by score."""
    rows: list[list[str]] = []
    for (model, size), cells in found.cells.items():
        transitions = DASH if runs_of(model) else f"{size:,}"  # those of a trained agent are its bench's to say
        scores = (over_seeds([score(cell, name) for cell in cells], _number, share=name in _SHARES) for name in columns)
        marks = {encoders.mark(cell.get("encoder_reads")) for cell in cells}
        rows.append([_title(model) + max(marks), transitions, *scores])
    header = ["world model", "transitions", *columns.values()]
    caption = "Interquartile means over seeds or runs, with 95 % intervals. 0 is best in every error; value loss and "
    return Table(table, header, rows, f"{caption}regret are in units of reward.", _WHY_DASH)


def _tables(found: Judged, name: str, columns: Mapping[str, str]) -> list[Table]:
    """Tables of all these scores, as many as fit the page beside each other in each."""
    parts = np.array_split(list(columns.items()), math.ceil(len(columns) / _MOST_SCORES))
    return [_scores(found, f"{name}_{at}" if at > 1 else name, dict(part)) for at, part in enumerate(parts, 1)]


def in_short(found: Judged) -> Section:
    """The main scores of each model at the most transitions, and the reader's own errors."""
    most = {model: size for model, size in sorted(found.cells, key=itemgetter(1))}
    newest = replace(found, cells={key: each for key, each in found.cells.items() if most[key[0]] == key[1]})
    errors = {name: f"{share:.2%}" for name, share in read_json(found.folder / "reader.json", "errors").items()}
    words = (
        "Imagined images are read as macrostates by a network, the reader, that was trained apart from all models. Its "
        "own errors are in the second table: the shares of real frames that it takes for another macrostate or does "
        "not recognize, and the shares of fog, noise and blends of two frames that it wrongly takes for a real frame. "
        "Each model is shown after the most transitions that it learned from; the tables below have all."
    )
    reader = Table.of("reader", [errors], "The errors of the reader of images itself.")
    return Section("In short", [words], tables=[_scores(newest, "short", SHORT), reader])


def question(found: Judged, title: str) -> Section:
    """The scores that answer one question, after every number of transitions."""
    name = title.lower().strip("?").replace(" ", "_").replace(",", "")
    return Section(title, [_WORDS[title]], tables=_tables(found, name, QUESTIONS[title]))


def levels(found: Judged) -> Section:
    """The scores of each level L0 to L7, its claims, and the policy that each model overrates most."""
    reader = "Returns of policies in a model hold the errors of the reader of its images, too, which stand above."
    films = []
    for model, arrays in shown(found.folder, found.judgement).items():
        if arrays.get("film"):
            films.append(film_image(model, _title(model), found.spec, arrays["film"], arrays))
    columns = {name: f"{level.name} {COLUMNS[name]}" for level in LEVELS for name in level.measures}
    tables = [*_tables(found, "levels", columns), claims_table()]
    return Section("From looks to exploits: L0 to L7", [reader], tables=tables, images=films)


def compared(found: Judged) -> Section:
    """Each pair's difference in unbiased Brier score at the most transitions, and a line on the two best that learned.

    Models whose score is not known, such as those that drew a single future, are left out.
    """
    every = {model: [score(cell, "unbiased") for cell in cells] for model, cells in found.last.items()}
    values = {model: scores for model, scores in every.items() if not any(map(math.isnan, scores))}
    learned = [model for model in values if not model_entry(model).privileged]
    best = sorted(learned, key=lambda model: iqm(values[model]))[:2]
    pairs = list(itertools.combinations(values, 2))
    differences = [difference(values[a], values[b]) for a, b in pairs]
    rows: list[list[str]] = []
    answers = []
    for pair, each, p in zip(pairs, differences, holm([each.p for each in differences]), strict=True):
        rows.append([*map(_title, pair), estimate(each, number), number(p)])
        if set(pair) == set(best):
            named = (f"{_title(model)} ({number(iqm(values[model]))})" for model in best)
            better = "it is better" if p < 0.05 else "no difference is shown"
            verdict = f"difference {estimate(each, number)}, p = {number(p)}, Holm-corrected: {better}"
            if not can_show((len(values[best[0]]), len(values[best[1]])), len(pairs)):
                verdict = "too few seeds to say which is better"
            answers.append(f"Smallest unbiased Brier score{found.after}: {', then '.join(named)}; {verdict}.")
    header = ["model", "against", "difference of unbiased Brier score", "p"]
    caption = f"Unbiased Brier score of one step{found.after}; Yuen's and Welch's tests over seeds, p by Holm."
    table = Table("differences", header, rows, caption, "too few seeds say nothing", "Every pair")
    return Section("Against each other", tables=[table], answers=answers)


def images(found: Judged) -> Section | None:
    """One rollout, transitions after the end of an episode and the worst ten of each model, real and as imagined."""
    arrays_of = shown(found.folder, found.judgement)
    sheets = [_sheet(found, "futures", "The same macro-actions from one real start.", "futures", arrays_of)]
    for model, arrays in arrays_of.items():
        if not arrays["worst_right"].all():
            caption = f"The ten worst transitions of {_title(model)}."
            sheets.append(_sheet(found, f"worst_{file_name(model)}", caption, "worst", {model: arrays}))
    ended = {model: arrays for model, arrays in arrays_of.items() if "after_before" in arrays}
    caption = "Macro-actions after the end of an episode, which no data contains."  # the thesis' figure 5.9
    sheets.append(_sheet(found, "after_the_end", caption, "after", ended))
    return Section("Real, and as each model imagines it", images=[each for each in sheets if each])


def _sheet(found: Judged, name: str, caption: str, kind: str, models: Mapping[str, Arrays]) -> Image | None:
    """Transitions, or a rollout's steps, before and after, real and imagined; None where no model has any."""
    if not models:
        return None
    (one, *_) = models.values()
    titles = [found.spec.action_names[action] for action in one[f"{kind}_actions"].flat]
    real = _joined(one[f"{kind}_real"])
    before = np.concatenate([one[f"{kind}_before"], real])[: len(real)]  # a rollout goes on from the real frame
    rows: list[TileRow] = [("before", before, None), ("real", real, None)]
    for model, arrays in models.items():
        rows.append((_title(model), _joined(arrays[f"{kind}_imagined"]), arrays[f"{kind}_right"].ravel().tolist()))
    return Image(name, png(transition_sheet(titles, rows)), caption)


def _joined(images: Pixels) -> Pixels:
    """Images of all steps of all transitions, one behind the other."""
    return images.reshape(-1, *images.shape[2:])


def whole_world(found: Judged) -> Section | None:
    """Questions about the whole world, at the most transitions."""
    return worlds_section(found.last, {model: _title(model) for model in found.last})


SECTIONS: tuple[Callable[[Judged], Section | None], ...] = (
    in_short,
    levels,
    images,
    *(functools.partial(question, title=title) for title in QUESTIONS),
    whole_world,
    compared,
)
"""The sections of the page, in their order. A new one is a function and a line here."""
