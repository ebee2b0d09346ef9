"""The report of a bench: one self-contained page, the same as Markdown, CSV and PNG, and a table for the terminal."""

from __future__ import annotations

import base64
import math
from pathlib import Path
from typing import Any

import numpy as np

from imagine_bench.judge.filmstrips import filmstrip, first_cut, png, sampled_filmstrips
from imagine_bench.report import plots
from imagine_bench.report import text as words
from imagine_bench.report.data import ReportData, collect, futures_csv, open_loop_csv, summary_csv
from imagine_bench.report.encoder import encoder_views
from imagine_bench.report.sections import Picture
from imagine_bench.report.template import render
from imagine_bench.report.text import agent_words, percent, score_text
from imagine_bench.store.archive import archive_files
from imagine_bench.store.files import make_folder, write_bytes
from imagine_bench.store.results import BenchResult, ComparedRollout

SHOWN_ROLLOUTS = 3
"""Rollouts shown of each imagining agent: the first ones of its first seed."""


def write_report(result: BenchResult) -> Path:
    """Write ``result.folder / "report"``: index.html, report.md, the CSV files and the pictures.

    Everything comes from ``result`` (and the bundled encoder's card), so writing it again gives the same report.

    Returns:
        The path of index.html.

    Raises:
        SetupError: The folder cannot be written.
    """
    folder = make_folder(result.folder / "report")
    data = collect(result)
    drawn = plots.all_plots(data)
    strips, sampled_rollouts = _strips(data), _courses(data)
    seen_through = encoder_views(result)
    shown = [(each, each.picture.read_bytes()) for each in seen_through if each.picture]
    context = {
        **_words(data),
        "plots": {plot.name: plot for plot in drawn},
        "strips": strips,
        "sampled_rollouts": sampled_rollouts,
        "encoders": seen_through,
        "encoder_pictures": {each.identity: base64.b64encode(picture).decode() for each, picture in shown},
    }
    pictures: list[plots.Plot | Picture] = [*drawn, *strips, *sampled_rollouts]
    files = {f"{each.name}.png": each.png for each in pictures}
    files |= {each.file: picture for each, picture in shown}
    files |= {name: text.encode() for name, text in archive_files(result).items()}
    if data.open_loop:
        files["open_loop.csv"] = open_loop_csv(result).encode()
    files["summary.csv"] = summary_csv(data).encode()
    if data.futures:
        files["futures.csv"] = futures_csv(data).encode()
    files["report.md"] = render("report.md.j2", context, **_NAMES).encode()
    files["index.html"] = render("report.html.j2", context, **_NAMES).encode()
    for name, content in files.items():
        write_bytes(folder / name, content)
    return folder / "index.html"


def summary_table(result: BenchResult) -> str:
    """Success (%) of every agent at every budget as plain text, chance level, optimum and thesis beside them."""
    data = collect(result)
    protocol = result.protocol
    header = ["real episodes", "chance", *(agent_words(agent).title for agent in protocol.agents), "optimum"]
    rows = [header]
    for budget in data.budgets:
        cells = [score_text(data.scores[agent][budget]) for agent in protocol.agents]
        rows.append([f"{budget:,}", percent(data.facts.chance_level), *cells, percent(data.facts.optimum)])
        if any(budget in printed for printed in data.thesis.values()):
            rows.append(_thesis_row(data, budget, "  thesis"))
    beyond = [budget for budget in _thesis_only(data) if budget > data.budgets[-1]]
    if beyond:
        rows.append(_thesis_row(data, beyond[0], f"thesis at {beyond[0]:,}"))
    title = (
        f"{data.spec.title}: test episodes solved, % [{_interval_words(data)}]; preset {protocol.preset}, "
        f"{protocol.execution}, {protocol.appearance}, {len(protocol.seeds)} seed(s) x "
        f"{protocol.evaluation_episodes} test episodes"
    )
    return "\n".join([title, "", *aligned(rows), "", *words.answers(data)])


def _thesis_row(data: ReportData, budget: int, name: str) -> list[str]:
    cells = [
        _thesis_text(data.thesis[agent][budget]) if budget in data.thesis.get(agent, {}) else ""
        for agent in data.result.protocol.agents
    ]
    return [name, "", *cells, ""]


def aligned(rows: list[list[str]]) -> list[str]:
    """Columns padded to the width of their widest cell, the first to the left and the others to the right."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [cell.rjust(width) for cell, width in zip(row, widths, strict=True)]
        lines.append("  ".join([row[0].ljust(widths[0]), *cells[1:]]).rstrip())
    return [lines[0], "-" * max(len(line) for line in lines), *lines[1:]]


def _words(data: ReportData) -> dict[str, Any]:
    """What both templates share."""
    protocol = data.result.protocol
    return {
        "data": data,
        "protocol": protocol,
        "question": words.question(data),
        "answers": words.answers(data),
        "interval_words": _interval_words(data),
        "thesis_only": _thesis_only(data),
        "seed_index": {seed: index for index, seed in enumerate(protocol.seeds)},
        "facts": facts(data.result),
        "settings": {agent: rows for agent in protocol.agents if (rows := _settings(data.result, agent))},
        "recordings": [_relative(run.recording, data.result.folder) for run in data.result.runs if run.recording],
    }


def _interval_words(data: ReportData) -> str:
    if len(data.result.protocol.seeds) == 1:
        return "95 % interval over test episodes only (Wilson; one seed says nothing about the luck of training)"
    return "95 % interval over seeds (bootstrap), given the test episodes, which are the same for every agent"


def _thesis_only(data: ReportData) -> list[int]:
    """Budgets of the thesis that this run does not have, ascending."""
    return sorted({budget for printed in data.thesis.values() for budget in printed} - set(data.budgets))


def _thesis_text(printed: tuple[float, float]) -> str:
    mean, std = printed
    return percent(mean) if math.isnan(std) else f"{percent(mean)} ({percent(std)})"


def _seconds(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:,.1f}"


def facts(result: Any) -> list[tuple[str, str]]:
    """How a result of any kind was made, name and value, nested values joined by a dot."""
    protocol = result.protocol
    rows = [
        ("protocol", f"{result.protocol_hash}, preset {protocol.preset}"),
        ("seeds", ", ".join(str(seed) for seed in protocol.seeds)),
        *flat("", result.environment),
    ]
    commit = result.environment.get("commit")
    command = result.environment.get("command", "")
    where = f"git checkout {str(commit).split('+')[0]} && " if commit else ""
    rows.append(("reproduce", f"{where}{command}"))
    return rows


def _settings(result: BenchResult, agent: str) -> list[tuple[str, str]]:
    """An agent's settings as run, by dotted name; the protocol gives all its seeds the same."""
    return flat("", result.of(agent)[0].settings)


def flat(prefix: str, value: Any) -> list[tuple[str, str]]:
    """Nested values as rows of dotted name and text."""
    if hasattr(value, "items"):
        return [row for key, inner in value.items() for row in flat(f"{prefix}.{key}" if prefix else str(key), inner)]
    if isinstance(value, list | tuple) and any(hasattr(item, "items") for item in value):
        return [row for count, item in enumerate(value, 1) for row in flat(f"{prefix}.{count}", item)]
    if isinstance(value, list | tuple):
        return [(prefix, "; ".join(str(item) for item in value))]
    return [(prefix, str(value))]


def _strips(data: ReportData) -> list[Picture]:
    strips = []
    for agent in data.result.protocol.agents:
        run = data.result.of(agent)[0]
        for index, compared in enumerate(run.imagined[:SHOWN_ROLLOUTS]):
            strips.append(_strip(data, agent, run.seed, index, compared))
    return strips


def _strip(data: ReportData, agent: str, seed: int, index: int, compared: ComparedRollout) -> Picture:
    title = agent_words(agent).title
    alive = np.concatenate([[True], ~compared.real_terminated[:-1]])  # imagined after the real end: nothing to match
    matches = (compared.rollout.macrostates == compared.real_macrostates).all(axis=1) & alive
    depth, cut = int(alive.sum()), first_cut(compared)
    kept = "nothing is cut" if cut is None else f"the filter cuts before macro-action {cut + 1}"
    caption = (
        f"{title[:1].upper()}{title[1:]}, seed {seed}, start {index + 1}: {int(matches.sum())} of {depth} imagined "
        f"macrostates are what the rules say; {kept}."
    )
    return Picture(
        name=f"rollout_{agent}_{index + 1}",
        png=png(filmstrip(compared, data.spec.action_names)),
        alt=f"Real frames above, imagined frames below. {caption}",
        caption=caption,
    )


def _courses(data: ReportData) -> list[Picture]:
    """One sheet an agent: several imagined sampled_rollouts of one beginning, of its first seed."""
    sheets = []
    for agent in data.result.protocol.agents:
        run = data.result.of(agent)[0]
        if run.sampled_rollouts:
            title = agent_words(agent).title
            caption = (
                f"{title[:1].upper()}{title[1:]}, seed {run.seed}: the same start {len(run.sampled_rollouts)} times."
            )
            sheet = png(sampled_filmstrips(run.sampled_rollouts, data.spec))
            alt = f"Only the first picture is real. {caption}"
            sheets.append(Picture(name=f"courses_{agent}", png=sheet, alt=alt, caption=caption))
    return sheets


def _relative(path: Path, folder: Path) -> str:
    return str(path.relative_to(folder)) if path.is_relative_to(folder) else str(path)


_NAMES = {
    "percent": percent,
    "signed": words.signed_percent,
    "estimate": words.estimate_text,
    "score_text": score_text,
    "thesis_text": _thesis_text,
    "seconds": _seconds,
    "lasting": words.lasting,
    "area_text": words.area_text,
    "words": agent_words,
    "color": plots.color,
}
"""What the templates call."""
