"""Sections of a bench's page on the world's exact facts, what policies do, why agents failed, and what they imagine."""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from imagine_bench.arrays import Arrays
from imagine_bench.exact.certificate import certificate_rows
from imagine_bench.judge.causes import CAUSES
from imagine_bench.judge.values import optimal_length, terminations
from imagine_bench.recording.filmstrips import filmstrip, png, sampled_filmstrips
from imagine_bench.registry.entries import file_name
from imagine_bench.report import figures
from imagine_bench.report.data import ReportData, agent_title, by_budget, known_agent, open_loop_means
from imagine_bench.report.page import DASH, Image, Section, Table, decimals, flat, over_seeds, percent, printed
from imagine_bench.rules import greedy
from imagine_bench.store import encoders
from imagine_bench.store.files import reading

HEAD = ("agent", "seed", "episodes", "tests", "test", "cause")
"""Columns of ``why/causes.csv``: a row a failure, and one a test without any, whose cause is empty."""
_SHARES = {
    "success": "solved",
    "failure": "ends otherwise",
    "late_success": "out of time, then solved",
    "late_failure": "out of time, then ends otherwise",
    "endless": "never ends",
}
SHOWN_ROLLOUTS = 3  # rollouts shown of each imagining agent: the first ones of its first seed
_MEASURES = (
    ("count", "transitions compared", ".0f"),
    ("correct", "macrostate right (%)", "%"),
    ("correct_accepted", "right among those kept (%)", "%"),
    ("accepted", "kept by the filter (%)", "%"),
    ("termination_error", "wrong about the end (%)", "%"),
    ("auroc_epistemic", "wrong ones found by epistemic (AUROC)", ".2f"),
    ("auroc_aleatoric", "by aleatoric", ".2f"),
    ("auroc_modal", "by modal", ".2f"),
    ("reward_mae", "reward error", ".3g"),
    ("epistemic", "epistemic", ".3g"),
    ("aleatoric", "aleatoric", ".3g"),
    ("modal", "modal", ".3g"),
)
_KINDS = ("epistemic", "aleatoric", "modal")


# What follows from the rules ----------------------------------------------------------------------------------------


def world(data: ReportData) -> Section | None:
    """What follows from the rules alone."""
    found = data.result.certificate
    if found is None:
        return None
    rows = {
        "macrostates": f"{found.macrostates:,}, {found.starts:,} of them starts; {found.horizon} macro-actions",
        "chance level": f"{percent(found.chance_level)} % by uniformly random macro-actions",
        "optimum": f"{percent(found.optimum)} % by perfect play that remembers all that frames showed",
        **certificate_rows(found),
    }
    words = "Nothing here is measured: all of it follows from the rules, by enumeration."
    return Section(
        "The world", [words], tables=[Table("certificate", ["", "certificate"], [*rows.items()], prose=True)]
    )


def policies(data: ReportData) -> Section | None:
    """What policies do from every start of the tests, by the rules.

    Only agents whose macro-action in every macrostate was kept at the last budget are followed. In each macrostate an
    agent does what it did in a frame of it that it read right, if one of a few was.
    """
    if not data.installed:
        return None
    starts = data.result.protocol.spec(testing=True).rules.start_states
    optimal = optimal_length(data.spec, starts)
    needs = optimal.round().astype(int)
    rows = []
    for agent in data.result.protocol.agents:
        kept = [run.checkpoints[-1].beliefs for run in data.result.of(agent)]
        if all(kept):
            actions = [greedy(one.action.astype(np.int64), data.spec.n_actions) for one in kept if one]
            found = [terminations(data.spec, policy, starts) for policy in actions]
            row: dict[str, str] = {"agent, %": agent_title(agent)}
            for name, words in _SHARES.items():
                row[words] = over_seeds([float(getattr(one, name).mean()) for one in found], share=True)
            for need in np.unique(needs):
                solved = [one.success[needs == need].mean() for one in found]
                row[f"solved from {need} away"] = percent(float(np.mean(solved)))
            row["macro-actions"] = over_seeds([float(one.length.mean()) for one in found], decimals)
            rows.append(row)
    if not rows:
        return None
    words = (
        f"At the last budget, each policy is followed by the rules from all {len(starts)} starts, of which the optimal "
        f"one solves each in {optimal.mean():.2f} macro-actions: no episode is sampled, and no frame misread that "
        "can be read right. Interquartile means over seeds [95 %]."
    )
    return Section("Where the greedy policies lead", [words], tables=[Table.of("policies", rows)])


def causes(data: ReportData) -> Section | None:
    """Causes by agent and budget, where 'imagine-bench verify --causes' left them in the bench's folder."""
    table = read_causes(data.result.folder)
    words = (
        "What an optimal policy fails with the same draws of chance, too, was bad luck. Else truth is swapped in, one "
        "stage at a time, until the episode is solved: frames read right; then a perfect plan in the agent's own "
        "model; then the truth about transitions that it never experienced; then all of the truth; then physics as the "
        "rules say. The first stage that solves it names the cause."
    )
    return Section("Why agents failed", [words], tables=[table]) if table.rows else None


def read_causes(bench: Path) -> Table:
    """What was found of a bench; without rows where nothing was. Raises ArtefactError: the file is damaged."""
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
    found: dict[tuple[str, str], list[list[str]]] = {}
    for row in rows:
        agent, seed, budget, tests, _, cause = map(str, row)
        if cause and cause not in CAUSES:
            raise ValueError(f"{cause!r} is no cause")
        found.setdefault((agent, budget), []).append([seed, tests, cause])
    lines = []
    for (agent, budget), own in found.items():
        counts = Counter(cause for _, _, cause in own if cause)
        total = counts.total()
        tested = sum({seed: int(tests) for seed, tests, _ in own}.values())
        shares = [percent(counts[name] / total) if total else DASH for name in CAUSES]
        lines.append([agent_title(agent), f"{int(budget):,}", f"{total:,} of {tested:,}", *shares])
    header = ["agent", "real episodes", "failures", *(f"{name}, %" for name in CAUSES)]
    meanings = "; ".join(f"{name}: {words}" for name, words in CAUSES.items())
    return Table("causes", header, lines, f"Shares of the failures. {meanings}.", why_dash="nothing failed")


# What agents see and imagine ----------------------------------------------------------------------------------------


def open_loop(data: ReportData) -> Section | None:
    """Imagination against the rules by depth."""
    loops = open_loop_means(data.result)
    if not loops:
        return None
    words = (
        "Imagination against the rules at the last budget: from real images, the model predicts ahead without looking "
        "again, and a probe that the agents never use reads the macrostate (the discrete state of the task) from what "
        "it imagines. Only chains of macro-actions that end no episode whatever chance may bring are compared. Means "
        "over seeds.",
        "AUROC: among transitions that began in the right macrostate, the probability that one that goes wrong has the "
        "higher uncertainty of two; 0.5 is chance, 1 is perfect.",
    )
    image = figures.image("open_loop", lambda: open_loop_figure(loops), "By imagined depth; means over seeds.")
    tables = []
    for agent, loop in loops.items():
        depths = (str(depth) for depth in range(1, 1 + len(loop["count"])))
        rows = []
        for name, title, form in _MEASURES:
            rows.append([title, *(percent(value) if form == "%" else printed(value, form) for value in loop[name])])
        why = "the filter keeps none, or none or all are wrong"
        header = [f"{agent_title(agent)}: depth", *depths]
        tables.append(Table(f"openloop_{file_name(agent)}", header, rows, why_dash=why))
    return Section("Open-loop error by depth", words, [image], tables)


def open_loop_figure(loops: Mapping[str, Arrays]) -> Figure:
    """The measures of the tables by imagined depth, a panel each; an agent that knows no such uncertainty says 0."""
    panels: dict[str, dict[str, dict[int, float]]] = {}
    for name, title, form in _MEASURES[1:]:
        scale = 100.0 if form == "%" else 1.0
        panels[title] = {
            agent_title(agent): dict(enumerate(scale * loop[name], 1))
            for agent, loop in loops.items()
            if name not in _KINDS or loop[name].any()
        }
    return figures.lines(panels, figures.colors(loops), "imagined depth (macro-actions)")


def rollouts(data: ReportData) -> Section | None:
    """Imagined rollouts beside the real ones, and several sampled from one start, of each agent's first seed."""
    images = []
    for agent in data.result.protocol.agents if data.installed else ():
        run = data.result.of(agent)[0]
        whose = f"{agent_title(agent)}, seed {run.seed}"
        for start, compared in enumerate(run.imagined[:SHOWN_ROLLOUTS], 1):
            strip = png(filmstrip(compared, data.spec.action_names))
            images.append(Image(f"rollout_{file_name(agent)}_{start}", strip, f"{whose}, start {start}."))
        if run.sampled_rollouts:
            sheet = png(sampled_filmstrips(run.sampled_rollouts, data.spec))
            caption = f"{whose}: the same start {len(run.sampled_rollouts)} times."
            images.append(Image(f"sampled_rollouts_{file_name(agent)}", sheet, caption))
    words = (
        "Imagined rollouts of the trained agents, by their own greedy choice of macro-actions, decoded back into "
        "images. Top row: what the real environment shows for the same macro-actions. Bottom row: what the agent "
        "imagined; a blue frame where it is what the rules say, an orange one where not. The first of a few starts are "
        "shown, which are the same for every agent; not the best.",
        "Where what happens next is partly chance, several rollouts are sampled from one real image, a row each. Below "
        "each image stands what has changed: in blue where the rules make it possible, in orange where not.",
    )
    return Section("What the agents imagine", words, images) if images else None


def acceptance(data: ReportData) -> Section | None:
    """Imagined transitions that the filter kept while training to each budget from the one before."""
    words = (
        "An imagined rollout is a chain of transitions that the agent's world model predicts, starting from a real "
        "image; depth counts its macro-actions. The uncertainty filter cuts a rollout at the first transition whose "
        "epistemic uncertainty (what the model does not know for want of data) is too high. Two other kinds are shown "
        "beside it: aleatoric (noise) and modal (several outcomes are possible)."
    )
    caption = "Share of the transitions imagined while training that were kept to be learned from. Means over seeds."
    first = "imagined transitions kept (%) up to"
    table = by_budget(
        data, "acceptance", first, "acceptance", lambda record: percent(record.get("acceptance", math.nan)), caption
    )
    return Section("Imagined transitions kept", [words], tables=[table]) if table.rows else None


def encoders_used(data: ReportData) -> Section | None:
    """The encoders that agents see through, with card and reconstructions, found beside the artefact.

    Raises:
        ArtefactError: A card is damaged.
    """
    readers: dict[str, list[str]] = {}
    for agent in data.result.protocol.agents:
        entry = known_agent(agent)
        identity = data.result.protocol.encoder_of(entry.encoder_kind)
        if entry.needs_encoder and identity is not None:
            readers.setdefault(identity, []).append(agent_title(agent))
    images = []
    tables = []
    for identity, agents in readers.items():
        name = identity.partition("@")[0]
        heading = f"{identity}, for {', '.join(agents)}"
        path = encoders.find(identity)
        if path is not None and path.with_suffix(".png").is_file():
            with reading(path.with_suffix(".png"), "an encoder's image"):
                content = path.with_suffix(".png").read_bytes()
            caption = f"{heading}: real frames the encoder never saw in training, and what it makes of them."
            images.append(Image(f"encoder-{name}", content, caption))
        card = flat("", encoders.card(identity) or {"card": "not here"})
        tables.append(Table(f"card-{name}", [heading, "its card"], list(map(list, card)), prose=True))
    words = (
        "Before any learning of the task, an encoder was trained once, on images without any rewards. It turns each "
        "image into a few numbers: a variational autoencoder into latents, one that finds factors into a code for each "
        "factor. The probe's accuracy is the share of held-out images whose whole macrostate can be read from them."
    )
    return Section("What the agents see", [words], images, tables) if tables else None
