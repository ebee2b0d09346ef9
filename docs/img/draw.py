"""Draws the pictures of the pages, from docs/results or from the scene: ``python docs/img/draw.py [NAME ...]``."""

import csv
import json
import runpy
import sys
from collections import Counter
from functools import partial
from pathlib import Path

import matplotlib as mpl
import numpy as np

from imagine_bench import reference, registry, statistics
from imagine_bench.exact.certificate import certificate
from imagine_bench.judge.causes import CAUSES, FORMER_CAUSES
from imagine_bench.registry.entries import agent_label, label_today
from imagine_bench.report import figures
from imagine_bench.report.data import collect
from imagine_bench.store.loading import load_so_far

mpl.use("agg")
from matplotlib import pyplot as plt

HERE = Path(__file__).parent
RESULTS = HERE.parent / "results"


def rates(folder: str, agent: str) -> dict[int, np.ndarray]:
    """Success of every seed, as a share, by budget."""
    found: dict[int, list[float]] = {}
    protocol = json.loads((RESULTS / folder / "bench.json").read_text())["protocol"]
    with (RESULTS / folder / "results.csv").open() as file:
        for row in csv.DictReader(file):
            if agent_label(row["agent"], protocol) == agent:
                share = int(row["successes"]) / int(row["test_episodes"])
                found.setdefault(int(row["episodes"]), []).append(share)
    return {budget: np.array(values) for budget, values in sorted(found.items())}


def curve(axes: plt.Axes, folder: str, agent: str, label: str | None = None, like: str = "") -> None:
    """Interquartile mean over seeds with its 95 % interval, or with the range of seeds that are too few for one.

    The line has the color and marks of the agent, or of another one that it is ``like``.
    """
    table = rates(folder, agent)
    budgets = list(table)
    tests = json.loads((RESULTS / folder / "bench.json").read_text())["protocol"]["evaluation_episodes"]
    means = [100 * statistics.iqm(values) for values in table.values()]
    intervals = [statistics.interval(values, trials=tests) for values in table.values()]
    if np.isnan(intervals).any():
        intervals = [(values.min(), values.max()) for values in table.values()]
    ends = 100 * np.array(intervals)
    style = figures.line_style(like or agent)
    axes.plot(budgets, means, label=label or agent, markersize=5, linewidth=2, **style)
    axes.fill_between(budgets, *zip(*ends, strict=True), color=style["color"], alpha=0.15, linewidth=0)


def finish(axes: plt.Axes, budgets: list[int]) -> None:
    """Axes that all plots share."""
    axes.set_xscale("log")
    axes.set_xticks(budgets, [f"{budget:,}" for budget in budgets])
    axes.minorticks_off()
    axes.set_ylim(-2, 104)
    axes.set_xlabel("real training episodes (logarithmic)")
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)


PEERS = (
    "arrow_puzzle-controls-networks", "arrow_puzzle-peers-sb3_latents", "arrow_puzzle-peers-sb3_pixels",
    "arrow_puzzle-peers", "arrow_puzzle-dreamer_latents",
)  # fmt: skip
"""Kept benches with the same tests after 100, 250 and 500 episodes; an agent of two is that of the first."""
LABEL_GAP = 4.5
"""Points of success between the names beside the curves, at least."""
LAST_EPISODE = 500
"""Where the curves end."""
RIGHT = 2_300
"""Macro-actions at the right edge, where the names stand."""
SETTINGS = {"replay_ratio": " tuned", "discount": " defaults"}
"""The words behind a name that has settings, by one that only those have."""


FAMILIES = {
    "imagination": ("trains on imagined episodes", "#d55e00", "D"),
    "dqn": ("DQN without a world model", "#0072b2", "o"),
    "count_table": ("counts or rules over discrete codes", "#202020", "s"),
    "sb3": ("another library", "#9a9a9a", "^"),
}
"""Kinds of agents, by the first word of a name: in words, a color and a marker."""
SAME_FAMILY = {"factored": "count_table", "posterior": "count_table", "dreamer": "sb3", "lewm": "sb3"}


def family(agent: str) -> tuple[str, str, str]:
    """The kind of an agent in words, its color and its marker."""
    for word, same in {**SAME_FAMILY, **dict(zip(FAMILIES, FAMILIES, strict=True))}.items():
        if agent.startswith(word):
            return FAMILIES[same]
    raise KeyError(f"{agent} belongs to no family of agents; name one in FAMILIES.")


def name_of_row(agent: str) -> str:
    """The name beside a row: as it is typed, with short words for settings."""
    settings = "".join(said for name, said in SETTINGS.items() if name in agent)
    label = agent if agent in registry.agents() else agent.partition(":")[0]
    return label + settings


def kept_curves() -> dict[str, tuple[list[float], list[float]]]:
    """Of each agent of PEERS, by budget: the macro-actions so far (mean) and the success (interquartile mean, in %)."""
    found: dict[str, tuple[list[float], list[float]]] = {}
    for kept in PEERS:
        data = collect(load_so_far(RESULTS / kept))
        for agent in dict.fromkeys(record["agent"] for record in data.records):
            if agent in found or not registry.agent_entry(agent).learns:
                continue
            rows = [row for row in data.records if row["agent"] == agent and row["episodes"] <= LAST_EPISODE]
            steps = {row["episodes"]: row["env_steps"] for row in rows}
            solved = dict(zip(data.result.protocol.budgets, data.result.success_rates(agent).T, strict=True))
            success = [100 * statistics.iqm(solved[budget]) for budget in sorted(steps)]
            found[agent] = ([steps[budget] for budget in sorted(steps)], success)
    return dict(sorted(found.items(), key=lambda each: -each[1][1][-1]))


NAMED_PEERS = (
    "factored:given", "factored", "count_table", "imagination", "dqn", "dqn_efficient", "sb3_dqn", "sb3_qrdqn",
    "sb3_ppo_latents", "lewm", "dreamer_v3 tuned",
)  # fmt: skip
"""The agents whose curves have a name; the others are drawn pale."""


def peers() -> None:
    """Success curves of our agents and of libraries' against real macro-actions."""
    figure, axes = plt.subplots(figsize=(9.4, 5.6), layout="constrained")
    ends: list[float] = []
    for agent, (steps, success) in kept_curves().items():
        _, color, marker = family(agent)
        is_named = name_of_row(agent) in NAMED_PEERS
        axes.plot(
            steps, success, marker=marker, color=color, markersize=4, linewidth=1.6, alpha=0.9 if is_named else 0.2
        )
        if not is_named:
            continue
        height = success[-1]
        while any(abs(height - other) < LABEL_GAP for other in ends):
            height -= LABEL_GAP / 4
        ends.append(height)
        axes.annotate(
            name_of_row(agent),
            (steps[-1], success[-1]),
            (RIGHT, height),
            fontsize=9,
            va="center",
            arrowprops={"arrowstyle": "-", "color": color, "alpha": 0.35, "linewidth": 0.7, "relpos": (0, 0.5)},
        )
    chance = 100 * certificate(registry.task("arrow_puzzle")).chance_level
    axes.axhline(chance, color="#777777", linestyle=":", linewidth=1)
    axes.set_xscale("log")
    ticks = [100, 200, 500, 1_000, 2_000]
    axes.set_xticks(ticks, [f"{tick:,}" for tick in ticks])
    axes.minorticks_off()
    axes.set(xlim=(100, RIGHT), ylim=(-4, 104), yticks=range(0, 101, 20))
    axes.set_xlabel("real macro-actions of training (logarithmic); dotted: chance")
    axes.set_ylabel("test episodes solved (%)")
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    title = "arrow puzzle, kinematic: interquartile means of five seeds; each line ends after 500 episodes"
    axes.set_title(title, fontsize=10, loc="left")
    for said, color, marker in FAMILIES.values():
        axes.plot([], [], marker=marker, color=color, label=said)
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, 0.8), frameon=False, fontsize=8)
    figure.savefig(HERE / "peers.png", dpi=120, facecolor="white", bbox_inches="tight")


LADDER = {
    "arrow_puzzle-controls-networks": (
        "dqn", "dqn_efficient", "dqn_codes", "dqn_swaps", "imagination", "imagination_exact_filter",
        "imagination_exact",
    ),
    "arrow_puzzle-controls-tabular": (
        "count_table", "count_table_directed", "count_table_directed_macrostate", "posterior_sampling",
    ),
    "arrow_puzzle-sample_efficiency": ("factored:given",),
}  # fmt: skip
"""Agents by the kept bench that tells most exactly when they reach 95 %; none of them was tested beyond the first's."""


def ladder() -> None:
    """Episodes to 95 % of each agent, and that of the cautious learner."""
    tested = {agent: rates(folder, agent) for folder, agents in LADDER.items() for agent in agents}
    reached: dict[str, list[int | None]] = {}
    for agent, table in tested.items():
        by_seed = np.stack(list(table.values()), axis=1)
        reached[agent] = [statistics.first_lasting(list(table), seed, 0.95) for seed in by_seed]
    cost = certificate(registry.task("arrow_puzzle")).learning_cost
    beyond = 1.6 * max(max(table) for table in tested.values())
    found = {agent: [beyond if each is None else each for each in seeds] for agent, seeds in reached.items()}
    order = sorted(found, key=lambda agent: (np.median(found[agent]), np.mean(found[agent])))
    figure, axes = plt.subplots(figsize=(9, 1.2 + 0.45 * len(order)), layout="constrained")
    for place, agent in enumerate(order):
        _, color, marker = family(agent)
        middle = np.median(found[agent])
        axes.plot([middle], [place], "|", color=color, markersize=24, markeredgewidth=1.5, alpha=0.5)
        for point, shift in zip(found[agent], np.linspace(-0.28, 0.28, len(found[agent])), strict=True):
            axes.plot([point], [place + shift], ">" if point == beyond else marker, color=color, markersize=4.5)
    if cost:
        axes.axvline(cost.episodes, **figures.REFERENCE)
        said = f"each marker is a seed, a line is their median; dashed: cautious learner, {cost.episodes:.0f} episodes"
        axes.set_title(said, fontsize=9, loc="left")
    axes.set_yticks(range(len(order)), order)
    axes.set_xscale("log")
    ticks = [50, 100, 200, 500]
    axes.set_xticks([*ticks, beyond], [*(f"{tick:,}" for tick in ticks), "not by 500"])
    axes.minorticks_off()
    axes.set_xlabel("real training episodes until 95 % of the tests are solved (logarithmic)")
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    for said, color, marker in list(FAMILIES.values())[:3]:
        axes.plot([], [], marker, color=color, label=said)
    axes.plot([], [], ">", color="#606060", label="95 % not reached")
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    figure.savefig(HERE / "ladder.png", dpi=110)


def thesis_settings() -> None:
    """Tables 5.1 and 5.3: ours and the thesis'."""
    figure, both = plt.subplots(1, 2, figsize=(10, 4), sharey=True, layout="constrained")
    for axes, task in zip(both, ("arrow_puzzle", "arrow_puzzle_hard"), strict=True):
        for agent in ("dqn", "imagination", "imagination_uncertainty"):
            curve(axes, f"{task}-thesis", agent)
            points = reference.success(task, agent)
            means = [100 * mean for mean, _ in points.values()]
            axes.plot(list(points), means, "*:", markersize=8, color=figures.color(agent), label=f"{agent}, thesis",
                      fillstyle="none")  # fmt: skip
        axes.set_title(task)
        finish(axes, [250, 500, 1000, 2000, 6000])
    both[0].set_ylabel("test episodes solved (%)")
    figure.legend(*both[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(HERE / "thesis_settings.png", dpi=150)


def rungs() -> None:
    """From the thesis' settings to those of quick: success of each seed, and the share that its model imagines
    rightly.
    """
    with (RESULTS / "arrow_puzzle-study-ladder" / "results.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["episodes"] == "1000"]
    names = list(dict.fromkeys(row["variant"] for row in rows))
    figure, axes = plt.subplots(figsize=(8, 0.8 + 0.32 * len(names)), layout="constrained")
    for place, name in enumerate(names):
        own = [row for row in rows if row["variant"] == name]
        color = figures.color("dqn" if own[0]["agent"] == "dqn" else "imagination")
        solved = [100 * float(row["success"]) for row in own]
        right = [100 * float(row["imagined_right"]) for row in own if row["imagined_right"]]
        axes.plot(solved, [place] * len(own), "o", color=color, alpha=0.6, markersize=5)
        axes.plot([np.mean(solved)], [place], "|", color=color, markersize=16, markeredgewidth=2.5)
        if right:
            axes.plot([np.mean(right)], [place], "D", color="#2b2b2f", fillstyle="none", markersize=6)
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xlim(-2, 102)
    figure.supxlabel("%: tests solved after 1,000 episodes (dots, bar: mean), model right (diamonds)", fontsize=9)
    axes.grid(axis="x", alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(HERE / "rungs.png", dpi=110)


def mild() -> None:
    """The ten reported seeds."""
    figure, axes = plt.subplots(figsize=(7, 3.2), layout="constrained")
    curve(axes, "arrow_puzzle-mild-ten_seeds", "imagination_uncertainty")
    curve(axes, "arrow_puzzle-mild-ten_seeds", "dqn")
    curve(axes, "arrow_puzzle-mild-dqn-five_updates", "dqn", "dqn, five updates\neach macro-action", like="count_table")
    axes.set_title("Interquartile mean of ten seeds; band: 95 % interval", fontsize=10)
    axes.set_ylabel("test episodes solved (%)")
    finish(axes, [500, 1000, 2000])
    figure.legend(loc="outside right upper", frameon=False)
    figure.savefig(HERE / "mild.png", dpi=150)


def margins() -> None:
    """Share of macro-actions as ruled against the physics of grasping, with Wilson's intervals."""
    labels = {
        "pad_friction": "friction of the fingertips",
        "finger_force_n": "most force of a finger (N)",
        "object_mass": "mass of an object (times)",
        "plan_error_mm": "planner's error (mm)",
        "plan_error_deg": "planner's error (degrees)",
    }
    figure, every = plt.subplots(1, len(labels), figsize=(13, 3), sharey=True, layout="constrained")
    for axes, (name, label) in zip(every, labels.items(), strict=True):
        for task, said, color in (("arrow_puzzle", "turning", "#0072b2"), ("pick_place", "picking", "#d55e00")):
            points = json.loads((RESULTS / "margins" / f"{task}.json").read_text())["curves"][name]
            values = [point["value"] for point in points]
            axes.plot(values, [100 * point["as_ruled"] / point["trials"] for point in points], "o-", color=color,
                      label=said, markersize=3)  # fmt: skip
            ends = [[100 * point[end] for point in points] for end in ("low", "high")]
            axes.fill_between(values, *ends, color=color, alpha=0.15, linewidth=0)
        if not name.startswith("plan"):
            axes.set_xscale("log")
        axes.set_xlabel(label)
        axes.set_ylim(-2, 104)
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    every[0].set_ylabel("macro-actions as ruled (%)")
    every[-1].legend(loc="center left", frameon=False)
    figure.savefig(HERE / "margins.png", dpi=110)


CAUSE_COLORS = ("#009e73", "#0072b2", "#7cc8f2", "#f0b400", "#d55e00", "#7a1f6b", "#9a9a9a", "#202020")


def failures(kept: Path) -> dict[str, dict[str, Counter[str]]]:
    """Failed tests of all seeds by agent, budget and cause; of a folder without causes, none."""
    found: dict[str, dict[str, Counter[str]]] = {}
    file = kept / "why.json"
    why = json.loads(file.read_text()) if file.exists() else {"runs": ()}
    for run in why["runs"]:
        of_agent = found.setdefault(agent_label(run["agent"], why), {})
        for budget, counts in run["failures"].items():
            now = {FORMER_CAUSES.get(cause, cause): count for cause, count in counts.items()}
            of_agent.setdefault(budget, Counter()).update(now)
    return found


def why() -> None:
    """Failures by cause: a panel an agent, a stacked bar a budget."""
    kept = RESULTS / "arrow_puzzle-mild-why"
    protocol = json.loads((kept / "bench.json").read_text())["protocol"]
    tests = protocol["evaluation_episodes"] * len(protocol["seeds"])
    found = failures(kept)
    shown = [agent for agent in found if agent != "factored:given"]
    figure, both = plt.subplots(1, len(shown), figsize=(3.4 * len(shown), 3.4), sharey=True, layout="constrained")
    for axes, agent in zip(both, shown, strict=True):
        bottom = np.zeros(len(found[agent]))
        for cause, color in zip(CAUSES, CAUSE_COLORS, strict=True):
            shares = np.array([100 * counts[cause] / tests for counts in found[agent].values()])
            if any(counts[cause] for each in shown for counts in found[each].values()):
                axes.bar(list(found[agent]), shares, bottom=bottom, color=color, label=cause)
            bottom += shares
        axes.set_title(agent, fontsize=9.5)
        axes.set_ylim(0, 100)
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_xlabel("real training episodes")
    both[0].set_ylabel("test episodes that failed (%)")
    figure.legend(*both[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(HERE / "why.png", dpi=130, facecolor="white")


CHALLENGES = ("unseen_goal-450", "changed_rule-450", "late_frames-716")


def separating() -> None:
    """Success in the world that separates and in the open challenges, beside chance: a panel each, a dot a seed.

    Failed tests stand above the solved ones, by cause, where causes are kept; those of all seeds that have them.
    """
    folders = [RESULTS / f"separating-{name}" for name in ("world-453", *CHALLENGES)]
    also = {
        "separating-world-453": {
            "factored": ["separating-world-710"],
            "factored:given": ["separating-world-given-710"],
            "laws:given": ["separating-world-given-710"],
            "lewm": [f"separating-world-lewm-{seed}" for seed in (453, 454, 455)],
        },
        **{
            f"separating-{name}-450": {agent: [f"separating-{name}-716"] for agent in ("factored", "laws:given")}
            for name in ("unseen_goal", "changed_rule")
        },
    }
    benches = [json.loads((folder / "bench.json").read_text()) for folder in folders]
    widths = [
        len({*kept["protocol"]["agents"], *also.get(folder.name, ())})
        for folder, kept in zip(folders, benches, strict=True)
    ]
    figure, every = plt.subplots(
        1, len(folders), figsize=(15.4, 3.6), width_ratios=widths, sharey=True, layout="constrained"
    )
    for axes, folder, kept in zip(every, folders, benches, strict=True):
        protocol = kept["protocol"]
        last = protocol["budgets"][-1]
        shown = {agent_label(agent, protocol): [folder.name] for agent in protocol["agents"]}
        shown |= also.get(folder.name, {})
        agents = sorted(shown)
        for place, agent in enumerate(agents):
            values = 100 * np.concatenate([rates(name, agent)[last] for name in shown[agent]])
            bottom = values.mean()
            axes.bar(place, bottom, width=0.6, color="#d9d9d9", label="solved" if agent == agents[0] else None)
            own = [RESULTS / name for name in shown[agent] if (RESULTS / name / "why.json").is_file()]
            places = own or [folder]  # causes of some folders are kept beside those of the first
            counts = sum((failures(each).get(agent, {}).get(str(last), Counter()) for each in places), Counter())
            for cause, color in zip(CAUSES, CAUSE_COLORS, strict=True):
                share = (100 - values.mean()) * counts[cause] / max(1, counts.total())
                axes.bar(place, share, bottom=bottom, width=0.6, color=color, label=cause if counts[cause] else None)
                bottom += share
            axes.plot([place] * len(values), values, ".", color=figures.INK)
        axes.axhline(100 * kept["certificate"]["chance_level"], color=figures.INK, linestyle="--", label="chance")
        axes.axhline(100 * kept["certificate"]["optimum"], color=figures.INK, linewidth=0.8, label="optimum")
        lines = [agent.replace("_", "\n").replace(":", ":\n") for agent in agents]
        axes.set_xticks(range(len(agents)), lines, fontsize=7.5)
        episodes = last + (protocol["after_episodes"] if protocol["after"] else 0)
        name = folder.name.split("-")[1].replace("_", " ").replace("world", "separating")
        axes.set_title(f"{name}: {episodes:,} episodes", fontsize=9.5)
        axes.set_ylim(0, 104)
        axes.spines[["top", "right"]].set_visible(False)
    every[0].set_ylabel("test episodes solved (%)")
    named = dict(zip(*reversed(every[0].get_legend_handles_labels()), strict=True))
    figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=len(named), frameon=False)
    figure.savefig(HERE / "separating.png", dpi=120, facecolor="white")


def suite() -> None:
    """Scores of the kept suites as a heat map; they are of two seeds, too few for an interval."""
    scores: dict[str, dict[str, float]] = {}
    for kept in ("suite", "suite-own"):
        with (RESULTS / kept / "scores.csv").open() as file:
            for row in csv.DictReader(file):
                scores.setdefault(label_today(row["agent"]), {})[row["experiment"]] = float(row["score"] or "nan")
    experiments = list(dict.fromkeys(name for found in scores.values() for name in found))
    cells = np.array([[found.get(name, np.nan) for found in scores.values()] for name in experiments])
    figure, axes = plt.subplots(figsize=(9.0, 5.4), layout="constrained")
    shown = axes.imshow(np.clip(cells, 0.0, 1.0), cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    for (row, column), score in np.ndenumerate(cells):
        said = "not run" if np.isnan(score) else f"{score:.2f}"
        axes.text(column, row, said, ha="center", va="center", color="white" if score > 0.55 else figures.INK)
    axes.set_xticks(range(len(scores)), list(scores))
    axes.set_yticks(range(len(experiments)), [name.replace("_", " ") for name in experiments])
    axes.tick_params(length=0, top=True, labeltop=True, bottom=False, labelbottom=False)
    axes.spines[:].set_visible(False)
    axes.set_xlabel("score: 0 as good as chance, 1 as good as an optimal player; means of two seeds", fontsize=9)
    figure.colorbar(shown, ax=axes, shrink=0.6)
    figure.savefig(HERE / "suite.png", dpi=110, facecolor="white")


FIGURES = (
    peers,
    ladder,
    thesis_settings,
    rungs,
    mild,
    margins,
    why,
    separating,
    suite,
)
ELSEWHERE = {
    "draw_scenes.py": ("parameters", "nuisances", "tasks"),
    "draw_judged.py": ("evidence", "promise", "ranking"),
}
"""Pictures of other files."""


def draw_elsewhere(file: str, name: str) -> None:
    """Draw a picture of another file."""
    runpy.run_path(str(HERE / file))[name]()


PICTURES = {each.__name__: each for each in FIGURES} | {
    name: partial(draw_elsewhere, file, name) for file, names in ELSEWHERE.items() for name in names
}

if __name__ == "__main__":
    for name in sys.argv[1:] or PICTURES:
        PICTURES[name]()
