"""The page of a leaderboard: a table a world, each number linked to the episodes that it follows from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from imagine_bench import registry
from imagine_bench.board.check import NEVER_SHOWN, Checked
from imagine_bench.board.rows import Row
from imagine_bench.registry.entries import file_name
from imagine_bench.registry.machine import describe_environment
from imagine_bench.report import figures
from imagine_bench.report.page import (
    DASH,
    Page,
    Section,
    Table,
    count,
    decimals,
    over_seeds,
    percent,
    printed,
    seconds,
    texts,
)
from imagine_bench.store.files import make_folder, table_text, write_bytes

_PERSON = "person"
"""The prefix of people's names among players."""
_NOBODY = "no person has played here yet"


def _part(seed: int, budget: int) -> str:
    """The name of the place of a run's tests in the page of its row."""
    return f"seed-{seed}-after-{budget}"


def _linked(row: Row, budget: int, text: str) -> str:
    """A number, linked to the episodes of the row's first seed after a budget."""
    address = f"{row.name}.html#{_part(row.protocol.seeds[0], budget)}"
    return Markup('<a href="{}">{}</a>').format(address, text)


def _at(row: Row, budget: int, name: str) -> list[float]:
    """A figure or a price of each seed after a budget."""
    both = zip(row.vouched, row.claimed.prices, strict=True)
    found = [{**vars(figures), **vars(price)} for figures, price in both if figures.episodes == budget]
    return [float(each[name]) for each in found]


def _success(row: Row, budget: int) -> list[float]:
    solved = np.array(_at(row, budget, "successes"))
    shares: list[float] = (solved / row.protocol.evaluation_episodes).tolist()
    return shares


def _cells(each: Checked, row: Row) -> dict[str, str]:
    """The cells of a row at its last budget."""
    budget = row.protocol.budgets[-1]
    tests = row.protocol.evaluation_episodes
    claimed = row.claimed
    frames = math.nan if claimed.frames_beforehand is None else claimed.frames_beforehand
    solved = over_seeds(_success(row, budget), percent, trials=tests, share=True)
    mean_return = decimals(float(np.mean(_at(row, budget, "mean_return"))))
    return {
        "player (claimed)": claimed.agent,
        "solved, %": _linked(row, budget, solved),
        "return": _linked(row, budget, mean_return),
        "tests": f"{len(row.protocol.seeds)} x {tests:,}",
        "starts": each.starts,
        "real episodes (claimed)": f"{budget:,}",
        "macro-actions (claimed)": count(float(np.mean(_at(row, budget, "env_steps")))),
        "frames beforehand (claimed)": count(frames),
        "CPU s (claimed)": seconds(float(np.mean(_at(row, budget, "train_cpu_s")))),
        "seen beforehand (claimed)": claimed.seen_beforehand,
    }


def _curves(rows: Sequence[Row]) -> Figure:
    """Success (%) by claimed training episodes."""
    curves: dict[str, dict[int, float]] = {}
    for row in rows:
        named = row.claimed.agent if row.claimed.agent not in curves else row.name
        curves[named] = {budget: 100.0 * float(np.mean(_success(row, budget))) for budget in row.protocol.budgets}
    figure = figures.lines({"": curves}, figures.line_styles(curves), "real training episodes, as claimed")
    figure.axes[0].set_ylabel("tests solved (%)")
    return figure


def _section(world: str, found: Sequence[tuple[Checked, Row]]) -> Section:
    """The table and the curve of a world."""
    best_first = sorted(found, key=lambda pair: -float(np.mean(_success(pair[1], pair[1].protocol.budgets[-1]))))
    cells = [_cells(each, row) for each, row in best_first]
    if not any(row.claimed.agent.startswith(_PERSON) for _, row in found):
        cells.append({**dict.fromkeys(cells[0], DASH), "player (claimed)": f"{_PERSON}: {_NOBODY}"})
    protocol = found[0][1].protocol
    facts = registry.task(protocol.task).facts()
    words = [
        f"Chance solves {percent(facts.chance_level)} % of its episodes and an optimal player "
        f"{percent(facts.optimum)} %. Solved, return and tests follow from the episodes that a number leads to. The "
        "player, and all columns from real episodes on, are claims."
    ]
    name = file_name(world)
    rows = [row for _, row in found]
    image = figures.image(f"curve-{name}", lambda: _curves(rows), "Solved tests by claimed real training episodes.")
    table = Table.of(f"table-{name}", cells, "Solved: mean over seeds [95 % interval].", "nobody, or not said")
    return Section(world, words, images=[image], tables=[table])


def board_page(checked: Sequence[Checked]) -> Page:
    """The page of a board that was checked."""
    worlds: dict[str, list[tuple[Checked, Row]]] = {}
    for each in checked:
        if each.row is not None:
            worlds.setdefault(each.row.world, []).append((each, each.row))
    sections = [_section(world, found) for world, found in worlds.items()]
    held = sum(each.row is not None for each in checked)
    answer = f"{held} of {len(checked)} rows hold: each of their test episodes was played again, to equal results."
    verdicts = [[each.name, str(each)] for each in checked]
    sections += [
        Section("What a replay can never show", [NEVER_SHOWN], answers=[answer]),
        Section("Verdicts", tables=[Table("verdicts", ["row", "verdict"], verdicts, prose=True)]),
    ]
    environment = describe_environment()
    return Page(
        title="Leaderboard",
        subtitle="Rows that anyone can check: imagine-bench board check",
        question="Which agents solve unseen tests, and at what price?",
        table=Table("held", ["row", "starts"], [[each.name, each.starts] for each in checked]),
        sections=sections,
        files={"board.csv": table_text([cells for world, found in worlds.items() for cells in _csv(world, found)])},
        facts={"command": environment["command"], "commit": environment["commit"]},
    )


def _csv(world: str, found: Sequence[tuple[Checked, Row]]) -> list[Mapping[str, float | str]]:
    """A row a seed and budget, with everything that the page shows."""
    rows: list[Mapping[str, float | str]] = []
    for each, row in found:
        for tested, price in zip(row.vouched, row.claimed.prices, strict=True):
            named = {"world": world, "row": row.name, "player": row.claimed.agent, "starts": each.starts}
            rows.append({**named, **vars(tested), **vars(price)})
    return rows


def row_page(row: Row) -> Page:
    """The page of a row: its claims, and each test episode."""
    sections = []
    for place, tested in enumerate(row.vouched):
        kept = row.kept(place)
        episodes = [
            {
                "test": str(test),
                "start": " ".join(map(str, kept.starts[test].tolist())),
                "macro-actions": " ".join(map(str, kept.actions_of(test))),
                "return": printed(float(kept.returns[test]), "g"),
                "solved": "yes" if kept.success[test] else "no",
            }
            for test in range(len(kept.lengths))
        ]
        table = Table.of(_part(tested.seed, tested.episodes), episodes)
        title = (
            f"Seed {tested.seed} after {tested.episodes:,} episodes: {tested.successes:,} of {len(episodes):,} solved"
        )
        sections.append(Section(title, tables=[table]))
    names = registry.task(row.protocol.task).action_names
    legend = "; ".join(f"{number}: {name}" for number, name in enumerate(names))
    words = [f"Macro-actions: {legend}.", f"imagine-bench board check plays all of them again: {row.name}."]
    return Page(
        title=row.name,
        subtitle=row.world,
        question=NEVER_SHOWN,
        table=Table("claims", ["claim", "value"], []),
        sections=[Section("The tests", words), *sections],
        files={},
        facts={"claimed": asdict(row.claimed), "protocol": row.protocol.as_dict(), "round": row.round or "none"},
    )


def write_board(checked: Sequence[Checked], out: Path) -> Path:
    """Write the page of a board and the pages of its rows; returns the path of the first."""
    pages = {"": board_page(checked)} | {each.row.name: row_page(each.row) for each in checked if each.row is not None}
    make_folder(out)
    for name, page in pages.items():
        files = texts(page)
        files[f"{name or 'index'}.html"] = files.pop("index.html")
        for file, text in files.items():
            write_bytes(out / file, text.encode())
    return out / "index.html"
