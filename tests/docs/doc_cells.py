"""Cells of the pages' tables, each computed from docs/results: a function is a word of :mod:`doc_tables`' comments."""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import FunctionType
from typing import Any

import information_cells
import judge_cells
import numpy as np
import speed_cells
from kept import RESULTS, certificate_of, facts, table

from imagine_bench import reference, registry, rules, statistics
from imagine_bench.exact import motion
from imagine_bench.judge.scores import today
from imagine_bench.registry.entries import agent_label, label_today
from imagine_bench.report.page import over_seeds
from imagine_bench.running.bench import read_protocol
from imagine_bench.store import encoders
from imagine_bench.sweep.grid import GRIDS

KEPT = sorted(path.parent for path in RESULTS.rglob("bench.json") if path.parent.name != "report")
"""The folders of kept benches."""

Runs = dict[int, list[dict[str, str]]]
Estimator = Callable[..., statistics.Estimate]


BOLD = "**"
ITALIC = "*"  # of a cell that is worse, where bold means better


@dataclass(frozen=True)
class Compared:
    """A cell that compares two sets of runs: marked where the table's tests, taken together, show a difference."""

    text: str
    p: float
    detectable: Callable[..., float]  # of the number of tests
    mark: str = BOLD


def picked(path: str, **wanted: str) -> list[dict[str, str]]:
    """The rows of a kept CSV file that have these values; agents by today's names."""
    labels = [{**row, "agent": label_today(row["agent"])} if "agent" in row else row for row in table(path)]
    return [row for row in labels if all(row[name] == value for name, value in wanted.items())]


# Benches of agents -----------------------------------------------------------------------------------------------


@functools.cache
def runs(where: str) -> Runs:
    """Rows of one agent in a folder, ``FOLDER/AGENT``, by budget, each in the order of seeds."""
    folder, _, agent = where.rpartition("/")
    found: Runs = {}
    for row in table(f"{folder}/results.csv"):
        if agent_label(row["agent"], facts(f"{folder}/bench.json")["protocol"]) == agent:
            found.setdefault(int(row["episodes"]), []).append(row)
    if not found:
        raise ValueError(f"{where}: no such runs")
    return {budget: sorted(rows, key=lambda row: int(row["seed"])) for budget, rows in found.items()}


def scores(budget: str, where: str, column: str = "success_rate") -> np.ndarray:
    """One number a seed. Shape (seeds,)."""
    rows = runs(where)[int(budget)]
    if column == "success_rate":
        return np.array([int(row["successes"]) / int(row["test_episodes"]) for row in rows])
    return np.array([float(row[column]) for row in rows])


def trials(budget: str, where: str) -> int:
    """Test episodes of every seed."""
    return int(runs(where)[int(budget)][0]["test_episodes"])


def _compared(budget: str, treated: str, base: str, estimate: Estimator) -> Compared:
    return _tested(scores(budget, treated), scores(budget, base), trials(budget, treated), estimate)


def _tested(treated: np.ndarray, base: np.ndarray, tests: int, estimate: Estimator) -> Compared:
    """An estimate, tested as the difference."""
    size = functools.partial(statistics.detectable, treated, base, trials=tests)
    found = statistics.difference(treated, base, trials=tests)
    return Compared(signed(estimate(treated, base, trials=tests)), found.p, size)


def percent(share: float) -> str:
    return f"{100 * share:.1f}"


def points(share: float) -> str:
    """With its sign, a real minus."""
    return f"{100 * share + 0.0:+.1f}".replace("-", "−").replace("+0.0", "0.0").replace("−0.0", "0.0")


def iqm(budget: str, where: str) -> str:
    """Interquartile mean of the success rate / mean, % [95 % interval], or of few seeds (lowest to highest)."""
    return over_seeds(scores(budget, where).tolist(), trials=trials(budget, where), share=True)


def ahead(budget: str, treated: str, base: str) -> str | list[Compared]:
    """The same; bold where it is ahead of the base, italic where it is behind.

    The base itself, and who does not learn, are not tested.
    """
    if treated == base or not registry.agent_entry(treated.rpartition("/")[2]).learns:
        return iqm(budget, treated)
    found = _compared(budget, treated, base, statistics.difference)
    is_ahead = statistics.iqm(scores(budget, treated)) > statistics.iqm(scores(budget, base))
    return [replace(found, text=iqm(budget, treated), mark=BOLD if is_ahead else ITALIC)]


def interval(value: float, low: float, high: float) -> str:
    return f"{percent(value)} [{percent(low)}, {percent(high)}]"


def signed(estimate: statistics.Estimate) -> str:
    if np.isnan(estimate.low):
        return points(estimate.value)
    return f"{points(estimate.value)} [{points(estimate.low)}, {points(estimate.high)}]"


def mean_std(budget: str, where: str) -> str:
    """Mean (standard deviation), %."""
    values = scores(budget, where)
    return f"{percent(values.mean())} ({percent(values.std(ddof=1))})"


def average(budget: str, where: str) -> str:
    """Mean over seeds, %."""
    return percent(scores(budget, where).mean())


def worst_best(budget: str, where: str) -> str:
    """Mean [worst, best seed], %."""
    values = scores(budget, where)
    return f"{percent(values.mean())} [{100 * values.min():.0f}, {100 * values.max():.0f}]"


def scaled(budget: str, where: str) -> str:
    """Mean over seeds between the exact chance of the bench's world (0) and its optimum (1)."""
    exact = facts(f"{where.rpartition('/')[0]}/bench.json")["certificate"]
    found = (scores(budget, where).mean() - exact["chance_level"]) / (exact["optimum"] - exact["chance_level"])
    return f"{found:.2f}".replace("-", "−")


def seeds(budget: str, where: str) -> str:
    """Every seed, %."""
    return ", ".join(percent(value) for value in scores(budget, where))


def difference(budget: str, treated: str, base: str) -> list[Compared]:
    """Difference of interquartile means, points [95 %]."""
    return [_compared(budget, treated, base, statistics.difference)]


def gain(budget: str, treated: str, base: str) -> list[Compared]:
    """Gain of the means relative to the base, % [95 %]; tested as the difference."""
    return [_compared(budget, treated, base, statistics.gain)]


def _curves(where: str) -> tuple[list[int], np.ndarray]:
    """The budgets of an agent, and its scores at each. Shape (seeds, budgets)."""
    budgets = sorted(runs(where))
    return budgets, np.stack([scores(str(budget), where) for budget in budgets], axis=1)


def area(budget: str, where: str, task: str = "arrow_puzzle") -> str:
    """Mean success over all episodes to a budget, %: interquartile mean [95 %]."""
    budgets, table = _curves(where)
    means = statistics.running_means(budgets, table, _facts(task).chance_level)[:, budgets.index(int(budget))]
    return over_seeds(means.tolist(), trials=trials(budget, where), share=True)


def reached(where: str, level: str) -> np.ndarray:
    """First test of every seed from which on all reach a level; NaN where there is none. Shape (seeds,)."""
    budgets, table = _curves(where)
    found = [statistics.first_lasting(budgets, row, float(level)) for row in table]
    return np.array([np.nan if each is None else each for each in found])


def price(budget: str, where: str, what: str) -> str:
    """The experience of one run until a budget, mean over seeds: a column, or frames its encoder saw before."""
    folder, _, agent = where.rpartition("/")
    if what == "frames":
        entry = registry.agent_entry(agent)
        if not entry.needs_encoder:
            return "0"
        card = encoders.card(read_protocol(RESULTS / folder).encoder_of(entry.encoder_kind))
        return "–" if card is None else f"{card['recipe']['frames']:,}"
    values = [row.get(what) or "nan" for row in runs(where)[int(budget)]]
    mean = np.mean([float(value) for value in values])
    return "–" if np.isnan(mean) else f"{mean:,.0f}"


def price_to(where: str, level: str, what: str) -> str:
    """The same until the test from which on all reach a level, mean over seeds."""
    budgets = reached(where, level)
    if np.isnan(budgets).any():
        return "–"
    rows = [runs(where)[int(budget)][index] for index, budget in enumerate(budgets)]
    return f"{np.mean([float(row[what]) for row in rows]):,.0f}"


def coverage(law: str, what: str, count: str) -> str:
    """A rate of the simulation of intervals and tests at so many seeds, %; of too few an en dash."""
    kept = facts("coverage/coverage.json")
    rows = {(row["law"], row["seeds"]): row for row in kept["rows"] + kept["power"]}
    rate = rows[law, int(count)].get(what, "")
    return "–" if rate == "" else percent(rate)


def episodes_to(where: str, level: str) -> str:
    """Real episodes to a level, by seed."""
    return ", ".join("never" if np.isnan(each) else f"{each:.0f}" for each in reached(where, level))


def mean_episodes_to(where: str, level: str) -> str:
    """Their mean."""
    mean = reached(where, level).mean()
    return "–" if np.isnan(mean) else f"{mean:.0f}"


def first_of(name: str, *arguments: str) -> str:
    """A cell of all arguments but the last: of a row that names two things, the first."""
    return CELLS[name](*arguments[:-1])


def last_of(name: str, *arguments: str) -> str:
    """A cell of all arguments but the last but one: of a row that names two things, the second."""
    return CELLS[name](*arguments[:-2], arguments[-1])


@functools.cache
def _facts(task: str) -> Any:
    return rules.facts(registry.task(task).rules, registry.task(task).horizon)


def thesis(budget: str, task: str, agent: str) -> str:
    """The thesis' mean (standard deviation), %."""
    mean, std = reference.success(task, agent)[int(budget)]
    return f"*{percent(mean)}*" if np.isnan(std) else f"*{percent(mean)} ({percent(std)})*"


def thesis_mean(budget: str, task: str, agent: str) -> str:
    return f"*{percent(reference.success(task, agent)[int(budget)][0])}*"


def thesis_gain(budget: str, task: str, agent: str) -> str:
    return f"*{points(reference.gain(task, agent)[int(budget)])}*"


# Studies, models, policies, plans --------------------------------------------------------------------------------


def _study(folder: str, variant: str, budget: str) -> list[dict[str, str]]:
    return picked(f"{folder}/results.csv", variant=variant, episodes=budget)


def study(budget: str, folder: str, *variants: str) -> str:
    """Success of variants of a study, %: interquartile means."""
    return "; ".join(percent(statistics.iqm(_success(folder, variant, budget))) for variant in variants)


def study_right(budget: str, folder: str, variant: str) -> str:
    """The share that a variant's models know rightly of one macro-action, %: mean."""
    right = [float(row["imagined_right"]) for row in _study(folder, variant, budget) if row["imagined_right"]]
    return percent(float(np.mean(right))) if right else "–"


def study_difference(budget: str, folder: str, *variants: str) -> list[Compared]:
    """Against the variant that each is compared with, points [95 %]."""
    found, tests = [], GRIDS["factors"].evaluation_episodes
    for variant in variants:
        against = _study(folder, variant, budget)[0]["against"]
        pair = (np.array(_success(folder, each, budget)) for each in (variant, against))
        found.append(_tested(*pair, tests, statistics.difference))
    return found


def _success(folder: str, variant: str, budget: str) -> list[float]:
    return [float(row["success"]) for row in _study(folder, variant, budget)]


def answers(folder: str, agent: str, path: str) -> str:
    """A score of a bench's models, %: mean [95 % interval over seeds], or with few seeds (lowest to highest)."""
    runs = facts(f"{folder}/generalisation.json")["runs"]
    values: list[Any] = [run for run in runs if label_today(run["agent"]) == agent]
    for name in path.split("/"):
        values = [value[name] for value in values]
    low, high = statistics.interval(values, trim=0.0)
    if not np.isnan(low):
        return interval(np.mean(values), low, high)
    return f"{percent(np.mean(values))} ({percent(min(values))} to {percent(max(values))})"


def two_answers(folder: str, agent: str, which: str, *paths: str) -> str:
    """One of two answers of which a row speaks."""
    return answers(folder, agent, paths[int(which)])


OWN_PERCEPTION = ("factored", "lewm")
"""Agents that learn their perception from their own frames: no probe reads it, so nobody knows what they misread."""


def caused(agent: str, episodes: str, cause: str) -> str:
    """Failed tests of all seeds, or the share of them that has a cause, %; or the number of seeds.

    A folder may stand before the agent. A cause that cannot be named of an agent is a dash: ``misread`` without a
    probe; and of ``values`` and the two causes in a world model those that do not apply.
    """
    folder, _, agent = agent.rpartition("/")
    kept = facts(f"{folder or 'arrow_puzzle-mild-why'}/why.json")
    own = [run["failures"] for run in kept["runs"] if agent_label(run["agent"], kept) == agent]
    runs = [failures[episodes] for failures in own if episodes in failures]
    count = sum(sum(run.values()) for run in runs)
    if cause in ("all", "seeds"):
        return f"{count:,}" if cause == "all" else f"{len(runs)}"
    without_model = any("values" in run for failures in own for run in failures.values())
    excluded = {"planning", "model"} if without_model else {"values"}
    if cause in excluded or (cause == "misread" and agent in OWN_PERCEPTION):
        return "–"
    return percent(sum(run.get(cause, 0) for run in runs) / count) if count else "–"


def plans(folder: str, agent: str, key: str, episodes: str = "") -> str:
    """A count over the plans of an agent; ``solved`` with Wilson's interval where they are of one run."""
    found = [each for each in facts(f"{folder}/plans.json") if label_today(each["agent"]) == agent]
    found = [each for each in found if episodes in ("", str(each["episodes"]))]
    if key == "as_imagined":
        return f"{sum(each['steps_as_imagined'] for each in found):,} of {sum(each['steps'] for each in found):,}"
    total = sum(each[key] for each in found)
    if key != "solved":
        return f"{total}"
    attempted = sum(each["attempted"] for each in found)
    if len(found) > 1:
        return f"{total} of {attempted}"
    low, high = statistics.wilson(total, attempted)
    return f"{total} of {attempted} [{percent(low)}, {percent(high)}]"


def thesis_plans(key: str) -> str:
    """The same of the thesis; an en dash for a number that it lacks."""
    found = reference.load("arrow_puzzle")["plans"]
    if key == "solved":
        return f"*{found['solved']} of {found['attempted']}*"
    return f"*{found['optimal_among_solved']}*" if key == "optimal" else "–"


def futures(folder: str, agent: str, measure: str, depth: str) -> str:
    """Imagined against exact distributions at a depth, mean over runs."""
    rows = picked(f"{folder}/futures.csv", agent=agent, depth=depth)
    value = float(np.mean([float(row[measure]) for row in rows]))
    return f"{value:.1f}" if measure in ("missed", "hallucinated") else f"{value:.3f}"


def judged(folder: str, model: str, transitions: str, score: str) -> str:
    """A score of the judge: interquartile mean / mean over the seeds in which it is a number, as :func:`iqm`."""
    rows = [today(row) for row in picked(f"{folder}/scores.csv", model=model, transitions=transitions)]
    values = [float(row[score]) for row in rows if row[score]]
    if not values:
        return "–"
    shares = ("auroc", "total", "tv", "after", "counter", "best", "conformal", "risk", "outcome", "unreadable")
    share = score.startswith(shares)
    digits = 2 if share or "skill" in score or "unbiased" in score or score.startswith(("policy", "fidelity")) else 1
    digits = 3 if score.startswith("conformal_wrong") else digits
    few = f"; {len(values)} of {len(rows)}" if len(values) < len(rows) else ""
    return over_seeds(values, lambda number: f"{number:.{digits}f}".replace("-", "−"), share=share) + few


def judged_after(folder: str, model: str, score: str, transitions: str) -> str:
    """The score of a model that learned from so many transitions: the interquartile mean alone."""
    return re.sub(r" [\[(/].*", "", judged(folder, model, transitions, score))


# Regression, speed, rules ----------------------------------------------------------------------------------------


def choice(folder: str, network: str, measure: str, criterion: str) -> str:
    """A cell of choices.csv: mean (standard deviation), or ratio [95 %]."""
    return picked(f"{folder}/choices.csv", network=network, measure=measure)[0][criterion]


def thesis_error(criterion: str, samples: str) -> str:
    mean, std = reference.load("robot_ik")["cumulative_error"]["criteria"][criterion][samples]
    return f"*{mean:.2f} ({std:.2f})*"


def claim(folder: str, network: str, text: str, column: str) -> str:
    """A cell of claims.csv."""
    return picked(f"{folder}/claims.csv", network=network, claim=text)[0][column]


def decomposed(folder: str, network: str, where: str, column: str) -> str:
    """A cell of the table of equation 4.8."""
    rows = {next(iter(row.values())): row for row in table(f"{folder}/decomposition_{network}.csv")}
    return rows[where][column]


def probe(cubes: str, kind: str) -> str:
    """Held-out frames read right from an encoder of so many cubes, % by seed, and CPU seconds of the last seed."""
    paths = sorted(RESULTS.glob(f"arrows-encoders/arrows_{cubes}-clean{kind}-seed_*.json"))
    cards = [json.loads(path.read_text()) for path in paths]
    right = ", ".join(f"{100 * card['probe']['mlp']:.2f}" for card in cards)
    return f"{right}; {cards[-1]['cpu_s']['total']:.0f}"


def margin(task: str, setting: str, value: str) -> str:
    """Macro-actions as ruled at a value of a setting, % [95 %, Wilson]."""
    curve = facts(f"margins/{task}.json")["curves"][setting]
    (point,) = (point for point in curve if point["value"] == float(value))
    return interval(point["as_ruled"] / point["trials"], *statistics.wilson(point["as_ruled"], point["trials"]))


def walked(task: str, sense: str) -> str:
    """Macro-actions as ruled without a reset; furthest drift of an object; every length where a fault ended a walk."""
    (found,) = [each for each in facts(f"margins/{task}.json")["walks"] if each["sense"] == sense]
    text = f"{found['as_ruled']:,} of {found['actions']:,}; {found['drift_mm']:.1f} mm"
    return f"{text}; walks of {', '.join(map(str, found['lengths']))}" if found["faults"] else text


def by_hand(task: str, level: str, column: str) -> str:
    """A figure of the certificate of continuous control."""
    found = motion.certificate(registry.task(task), motion.measured(task)["appearances"][level])
    columns = {
        "at most": f"{100 * found.optimum:.1f} %",
        "at least": f"{100 * found.shown:.1f} %",
        "as ruled": f"{found.as_ruled:,} of {found.segments:,}",
        "solved": f"{found.solved} of {found.episodes}",
        "least": f"{found.least_s:.2f}",
        "mean": f"{found.mean_s:.2f} [{found.mean_low_s:.2f}, {found.mean_high_s:.2f}]",
        "longest": f"{found.longest_s:.1f}",
        "chance": f"{found.random_solved} of {found.random_episodes:,}" if found.random_episodes else "–",
    }
    return columns[column]


def goals_and_starts(task: str) -> str:
    spec = registry.task(task)
    goals = [state for state in spec.rules.states if spec.rules.is_terminal(state) and spec.rules.is_legal(state)]
    return f"{len(goals)} / {len(spec.rules.start_states)}"


def chance_exact(task: str) -> str:
    return f"{100 * _facts(task).chance_level:.3f}"


def optimum_exact(task: str) -> str:
    return f"{100 * _facts(task).optimum:.3f}"


def shortest(task: str) -> str:
    return f"{_facts(task).mean_plan_length:.3f}"


def certified(world: str, field: str) -> str:
    """A success probability of a world's certificate, %."""
    return percent(getattr(certificate_of(world), field))


CELLS: dict[str, Callable[..., str | list[Compared]]] = {
    name: function
    for name, function in {**vars(speed_cells), **vars(information_cells), **vars(judge_cells), **globals()}.items()
    if isinstance(function, FunctionType)
}
"""The words of comments: every function above and of the three modules."""
