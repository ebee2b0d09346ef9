"""The page of a leaderboard: a table a world, each number linked to the episodes that it follows from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from imagine_bench import registry
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

from .check import NEVER_SHOWN, Checked
from .motion_rows import RATE_HZ, MotionRow
from .rows import Claims, Row

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
    """A figure or a cost of each seed after a budget."""
    both = zip(row.vouched, row.claimed.prices, strict=True)
    found = [{**vars(figures), **vars(cost)} for figures, cost in both if figures.episodes == budget]
    return [float(each[name]) for each in found]


def _success(row: Row, budget: int) -> list[float]:
    solved = np.array(_at(row, budget, "successes"))
    shares: list[float] = (solved / row.protocol.evaluation_episodes).tolist()
    return shares


def _cells(row: Row) -> dict[str, str]:
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
        "starts": row.starts,
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


def _motion_cells(row: MotionRow) -> dict[str, str]:
    """The cells of a row of continuous control."""
    tests = row.protocol.tests
    vouched = {
        "solved, %": percent(row.vouched.successes / tests),
        "return": decimals(row.vouched.mean_return),
        "robot seconds a test": decimals(row.vouched.mean_periods / RATE_HZ),
        "faults": f"{row.vouched.faults:,}",
        "not reproducible": f"{row.vouched.not_reproducible:,}",
    }
    address = f"{row.name}.html#tests"
    linked = {name: Markup('<a href="{}">{}</a>').format(address, number) for name, number in vouched.items()}
    return {
        "player (claimed)": row.claimed.agent,
        **linked,
        "tests": f"{tests:,}",
        "starts": row.starts,
        "seen beforehand (claimed)": row.claimed.seen_beforehand,
    }


def _motion_section(world: str, rows: Sequence[MotionRow]) -> Section:
    """The table of a world of continuous control."""
    best_first = sorted(rows, key=lambda row: -row.vouched.mean_return)
    words = (
        "Each command, 25 a second, was carried out again. A test is not reproducible if tiny disturbances change its "
        "end; it counts as failed. The columns that are marked so are claimed."
    )
    table = Table.of(f"table-{file_name(world)}", [_motion_cells(row) for row in best_first], "", "not said")
    return Section(world, [words], tables=[table])


def _section(world: str, rows: Sequence[Row]) -> Section:
    """The table and the curve of a world."""
    best_first = sorted(rows, key=lambda row: -float(np.mean(_success(row, row.protocol.budgets[-1]))))
    cells = [_cells(row) for row in best_first]
    if not any(row.claimed.agent.removeprefix("trained_").startswith(f"{_PERSON}:") for row in rows):
        cells.append({**dict.fromkeys(cells[0], DASH), "player (claimed)": f"{_PERSON}: {_NOBODY}"})
    facts = rows[0].protocol.spec(testing=True).facts()
    words = [
        f"Chance solves {percent(facts.chance_level)} % of its episodes and an optimal player who sees all "
        f"{percent(facts.optimum)} %. Solved, return and tests follow from the episodes that a number leads to. The "
        "columns that are marked so are claimed."
    ]
    name = file_name(world)
    image = figures.image(f"curve-{name}", lambda: _curves(rows), "Solved tests by claimed real training episodes.")
    table = Table.of(
        f"table-{name}", cells, "Solved: mean over seeds (lowest to highest) or [95 % interval].", "nobody, or not said"
    )
    return Section(world, words, images=[image], tables=[table])


def board_page(checked: Sequence[Checked]) -> Page:
    """The page of a board that was checked."""
    worlds: dict[str, list[Row]] = {}
    moved: dict[str, list[MotionRow]] = {}
    for each in checked:
        if isinstance(each.row, Row):
            worlds.setdefault(each.row.world, []).append(each.row)
        elif each.row is not None:
            moved.setdefault(each.row.world, []).append(each.row)
    sections = [_section(world, rows) for world, rows in worlds.items()]
    sections += [_motion_section(world, rows) for world, rows in moved.items()]
    held = sum(each.row is not None for each in checked)
    answer = f"{held} of {len(checked)} rows hold: each of their test episodes was played again, to equal results."
    verdicts = Table("verdicts", ["row", "verdict"], [[each.verdict.what, str(each)] for each in checked], prose=True)
    sections += [
        Section("What a replay can never show", [NEVER_SHOWN], answers=[answer]),
        Section("Verdicts", tables=[verdicts]),
    ]
    environment = describe_environment()
    return Page(
        title="Leaderboard",
        subtitle="Rows that anyone can check: imagine-bench board check",
        question="Which agents solve unseen tests, and at what cost?",
        table=verdicts,
        sections=sections,
        files={"board.csv": table_text([cells for rows in worlds.values() for row in rows for cells in _csv(row)])},
        facts={"command": environment["command"], "commit": environment["commit"]},
    )


def _csv(row: Row) -> list[Mapping[str, float | str]]:
    """A row a seed and budget, with everything that the page shows."""
    named = {"world": row.world, "row": row.name, "player": row.claimed.agent, "starts": row.starts}
    both = zip(row.vouched, row.claimed.prices, strict=True)
    return [{**named, **vars(tested), **vars(cost)} for tested, cost in both]


def motion_page(row: MotionRow, verdict: str) -> Page:
    """The page of a row of continuous control: its verdict, each test episode, and its claims."""
    episodes = [
        {
            "test": str(test),
            "start (the environment's seed)": str(row.protocol.start(test)),
            "robot seconds": decimals(each.periods / RATE_HZ),
            "return": printed(each.total_reward, "g"),
            "solved": "yes" if each.solved else "no",
            "fault": "yes" if each.fault else "no",
            "reproducible": "yes" if each.reproducible else "no, so it counts as failed",
        }
        for test, each in enumerate(row.motions)
    ]
    title = f"{row.vouched.successes:,} of {len(episodes):,} tests solved"
    tests = Section(title, answers=[verdict], tables=[Table.of("tests", episodes)])
    return _page_of(row.name, row.world, [tests], row.claimed, asdict(row.protocol), row.round)


def row_page(row: Row, verdict: str) -> Page:
    """The page of a row: its verdict, each test episode, and its claims."""
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
    tests = Section("The tests", [f"Macro-actions: {legend}."], answers=[verdict])
    return _page_of(row.name, row.world, [tests, *sections], row.claimed, row.protocol.as_dict(), row.round)


def _page_of(
    name: str, world: str, sections: list[Section], claimed: Claims, protocol: Mapping[str, Any], round_name: str
) -> Page:
    """The page of a row of any kind."""
    return Page(
        title=name,
        subtitle=world,
        question="Do these actions, from these starts, have these outcomes?",
        table=Table("claims", ["claim", "value"], []),
        sections=sections,
        files={},
        facts={"claimed": asdict(claimed), "protocol": dict(protocol), "round": round_name or "none"},
    )


def _page_of_row(row: Row | MotionRow, verdict: str) -> Page:
    return row_page(row, verdict) if isinstance(row, Row) else motion_page(row, verdict)


def write_board(checked: Sequence[Checked], out: Path) -> Path:
    """Write the page of a board and the pages of its rows; returns the path of the first."""
    pages = {"": board_page(checked)} | {
        each.row.name: _page_of_row(each.row, str(each)) for each in checked if each.row is not None
    }
    make_folder(out)
    for name, page in pages.items():
        files = texts(page)
        files[f"{name or 'index'}.html"] = files.pop("index.html")
        for file, text in files.items():
            write_bytes(out / file, text.encode())
    return out / "index.html"
