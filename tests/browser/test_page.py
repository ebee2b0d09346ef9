"""The page of the puzzle in a browser: its rules, facts, rows and model are those of the package.

They run in Node.js, which needs no network. The arm and the page itself are in test_built.py.
"""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from imagine_bench_board.motion_rows import MotionRow, read_motions
from imagine_bench_board.motions import SLACK_PERIODS
from whole_outputs import KEPT, Expected

from imagine_bench import registry
from imagine_bench.errors import ArtefactError, ImagineBenchError

ROOT = Path(__file__).parents[2]
BROWSER = ROOT / "docs" / "browser"
PAGE = BROWSER / "page"
ANSWERS = Path(__file__).with_name("answers.mjs")
NODE = shutil.which("node")
needs_node = pytest.mark.skipif(NODE is None, reason="Node.js is not installed: the page's modules cannot run")
WORLDS = (
    "arrow_puzzle",
    "arrow_puzzle_hard",
    "arrow_puzzle_toward",
    "arrow_puzzle_clockwise",
    "arrow_puzzle_easy",
    "arrow_puzzle:slip=0.1",
    "arrows:cubes=4,slip=0.1",
    "arrows:cubes=4,forbid=none,goal=0123",
    "arrows:cubes=2,goal=all,forbid=none",
    "arrows:coupling=neighbour,forbid=none",
    "arrows:shuffle=7",
    "arrows:shuffle=4294967295,cubes=4",
    "arrows:fickle=0.3,slip=0.25",
    "arrows:goal_change=1.0,cubes=2,forbid=none",
    "arrows:forbid=neighbours+agent,cubes=5",
    "arrows:horizon=3,gesture=first",
)
PICK_WORLDS = (
    "pick_place",
    "pick_place:slip=0.1",
    "pick_place:fickle=0.3,slip=0.25",
    "pick_place:goal_change=1.0",
    "pick_place:gesture=first,slip=0.5",
)
ASKED = 2_000
LONG = ("world", "arrows:" + "slip=0.1," * 5_000)


def ask(questions: list[dict[str, object]]) -> list[Any]:
    """Answers of the page's modules."""
    assert NODE is not None
    command = [NODE, str(ANSWERS), str(PAGE)]
    done = subprocess.run(command, input=json.dumps(questions), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    answers: list[Any] = json.loads(done.stdout)
    return answers


@pytest.fixture(name="made")
def _made(monkeypatch: pytest.MonkeyPatch) -> None:
    """The scripts that make the page can be imported."""
    monkeypatch.syspath_prepend(str(BROWSER))


@pytest.mark.usefixtures("made")
def test_constants_are_those_of_the_rules() -> None:
    import constants

    assert constants.OUT.read_text() == constants.text(), "run python docs/browser/constants.py"


@needs_node
@pytest.mark.parametrize("worlds", [WORLDS, PICK_WORLDS], ids=["arrows", "pick_place"])
def test_2000_macro_actions_have_pythons_outcomes(worlds: tuple[str, ...]) -> None:
    rng = np.random.default_rng(400)
    questions: list[dict[str, object]] = []
    expected = []
    for line in worlds:
        rules = registry.task(line).rules
        states = rules.states
        asked = [
            (states[int(rng.integers(len(states)))], int(rng.integers(rules.n_actions)))
            for _ in range(ASKED // len(worlds))
        ]
        questions.append({"kind": "outcomes", "line": line, "asked": asked})
        expected.append([rules.outcomes(state, action) for state, action in asked])
    assert sum(map(len, expected)) == ASKED
    for line, found, wanted in zip(worlds, ask(questions), expected, strict=True):
        for mine, truth in zip(found, wanted, strict=True):
            assert [tuple(each.pop("macrostate")) for each in mine] == [each.macrostate for each in truth], line
            for one, outcome in zip(mine, truth, strict=True):
                assert one == {name: pytest.approx(getattr(outcome, name)) for name in one}, line
            assert all(one.keys() == {"probability", "reward", "terminated", "success"} for one in mine)


@needs_node
def test_worlds_have_pythons_turns_starts_and_horizon() -> None:
    lines = (*WORLDS, *PICK_WORLDS)
    for line, found in zip(lines, ask([{"kind": "world", "line": line} for line in lines]), strict=True):
        spec = registry.task(line)
        assert found["horizon"] == spec.horizon, line
        assert [tuple(state) for state in found["starts"]] == list(spec.rules.start_states), line
        if line in PICK_WORLDS:
            assert [tuple(state) for state in found["states"]] == list(spec.rules.states), line
            continue
        turns = [[(turn["cube"], turn["clockwise"]) for turn in each] for each in found["turns"]]
        assert turns == [[(turn.cube, turn.clockwise) for turn in each] for each in spec.rules.world.turns], line


@needs_node
def test_chance_and_optimum_are_pythons() -> None:
    slow = [line for line in WORLDS if "cubes=5" in line]
    endless = "pick_place:goal_change=1.0"  # its return has no bound, so Python refuses to compute it
    lines = [line for line in (*WORLDS, *PICK_WORLDS) if line not in (*slow, endless)]
    for line, found in zip(lines, ask([{"kind": "facts", "line": line} for line in lines]), strict=True):
        facts = registry.task(line).facts()
        assert found["chance"] == pytest.approx(facts.chance_level, abs=1e-12), line
        assert found["optimum"] == pytest.approx(facts.optimum, abs=1e-12), line


@needs_node
def test_a_share_below_1_is_never_shown_as_100_percent() -> None:
    shares = {1.0: "100.00 %", 1.0 - 1e-13: "100.00 %", 0.99999: "99.99 %", 0.04602: "4.60 %", 0.0: "0.00 %"}
    assert ask([{"kind": "percent", "share": share} for share in shares]) == list(shares.values())


@needs_node
def test_hostile_worlds_and_rows_are_refused_in_one_sentence(expected: Expected) -> None:
    """Rows are forged: their episodes are none of the rules."""
    kept = (KEPT / "refused_by_the_page.txt").read_text(encoding="utf-8")
    asked = [(kind, json.loads(text)) for kind, text in re.findall(r"^\$ (\w+) (.*)$", kept, re.MULTILINE)]
    names = {"world": "line", "rowFile": "name", "row": "row"}
    *found, endless = ask([{"kind": kind, names[kind]: given} for kind, given in [*asked, LONG]])
    assert endless["refused"].endswith("has 45007 characters; give at most 200.")
    answers = []
    for (kind, given), answer in zip(asked, found, strict=True):
        assert len(answer["refused"]) < 400
        answers += [f"$ {kind} {json.dumps(given)}", answer["refused"]]
        if kind == "world":
            with pytest.raises(ImagineBenchError):
                registry.task(given)
    expected("refused_by_the_page", "\n".join(answers))
    assert ask([{"kind": "rowFile", "name": "dqn-f2c3"}]) == ["data/rows/dqn-f2c3.json"]


EPISODE = {"start": [3, 1, 2, 0], "actions": [0], "states": [[0, 1, 2, 0]], "success": True}
ROW: dict[str, Any] = {"title": "somebody", "world": "arrow_puzzle", "episodes": [EPISODE]}
HANDED_OVER = {"start": [0, 0, 0, 1], "actions": [1, 3], "states": [[0, 1, 0, 3], [0, 2, 0, 3]], "success": True}
WRONG = {"start": [0, 0, 0, 1], "actions": [0], "states": [[1, 0, 0, 4]], "success": False}
PICK_ROW = {"title": "somebody", "world": "pick_place", "episodes": [HANDED_OVER, WRONG]}


@needs_node
def test_rows_as_the_rules_have_them_are_taken() -> None:
    assert ask([{"kind": "row", "row": row} for row in (ROW, PICK_ROW)]) == [1, 2]


@pytest.mark.usefixtures("made")
def test_the_row_of_most_episodes_of_the_first_seed_is_converted() -> None:
    import rows

    log = {"starts": [[3, 1, 2, 0], [3, 1, 2, 0]], "actions": [[0], [1, 1]], "solved": "10"}
    card = {
        "protocol": {"task": "arrow_puzzle"},
        "claimed": {"agent": "dqn"},
        "vouched": [
            {"seed": seed, "episodes": episodes, "successes": 1, "test_episodes": 2}
            for seed, episodes in ((400, 100), (400, 250), (401, 500))
        ],
    }
    states = [[2, 1, 2, 0], [1, 1, 2, 0]]
    lost = {"start": log["starts"][1], "actions": [1, 1], "states": [tuple(each) for each in states], "success": False}
    won = {**EPISODE, "states": [(0, 1, 2, 0)]}
    title = "dqn, 250 episodes: 1 of 2 solved"
    row = rows.converted(card, [{}, log, {}])
    assert row == {"title": title, "world": "arrow_puzzle", "episodes": [won, lost]}
    card["protocol"] = {"task": "arrow_puzzle:slip=0.1"}
    assert rows.converted(card, [{}, log, {}]) is None


Moved = Callable[..., tuple[MotionRow, dict[str, Any]]]


@pytest.fixture
def moved(made: None, monkeypatch: pytest.MonkeyPatch) -> Moved:
    """Gives a row of the board with its first tests alone and a change of its protocol or motions; and it for the
    page.
    """
    import rows

    def changed(tests: int, name: str = "expert-motion-arrow_puzzle", **change: Any) -> tuple[MotionRow, Any]:
        kept = read_motions(rows.BOARD / name)
        task = change.pop("task", kept.protocol.task)
        row = dataclasses.replace(
            kept,
            protocol=dataclasses.replace(kept.protocol, task=task, tests=tests),
            motions=tuple(dataclasses.replace(each, **change) for each in kept.motions[:tests]),
        )
        monkeypatch.setattr(rows.motion_rows, "read_motions", lambda _: row)
        monkeypatch.setattr(rows.motions, "check_motions", lambda *_: row)
        return row, json.loads(json.dumps(rows.moved(rows.BOARD)))

    return changed


@needs_node
@pytest.mark.parametrize(
    ("name", "solved", "faults"),
    [
        ("expert-motion-arrow_puzzle", 4, 0),
        ("random-motion-arrow_puzzle", 0, 2),
        ("expert-motion-pick_place", 4, 0),
        ("random-motion-pick_place", 0, 2),
    ],
)
def test_actions_of_continuous_control_are_the_events_of_the_replay(
    moved: Moved, name: str, solved: int, faults: int
) -> None:
    """Each command is one step of the environment here, and infos are read; the page's script reads events."""
    row, found = moved(4, name)
    agent, _, task = name.split("-")
    assert found["title"].startswith(f"{agent}, continuous control in {task}, each event as a planned movement: ")
    assert found["world"] == task
    ended_by_fault = 0
    with closing(row.protocol.make(observation="state")) as env:
        for test, (motion, episode) in enumerate(zip(row.motions, found["episodes"], strict=True)):
            _, info = env.reset(seed=row.protocol.start(test))
            assert episode["start"] == info["macrostate"].tolist()
            events = []
            for command in np.concatenate([motion.commands, np.repeat(motion.commands[-1:], SLACK_PERIODS, axis=0)]):
                _, _, terminated, truncated, info = env.step(command)
                if info["event"] and not info["fault"]:
                    events.append((int(info["macro_action"]), info["macrostate"].tolist()))
                if terminated or truncated:
                    break
            assert terminated or truncated
            ended_by_fault += bool(info["fault"])
            assert list(zip(episode["actions"], episode["states"], strict=True)) == events
            assert episode["success"] == (info["is_success"] and motion.reproducible)
            assert not motion.reproducible or episode["success"] == motion.solved
    assert sum(each["success"] for each in found["episodes"]) == solved
    assert ended_by_fault >= faults
    assert ask([{"kind": "row", "row": found}]) == [4], "the page takes it"


@needs_node
def test_a_test_is_solved_only_if_it_is_reproducible(moved: Moved) -> None:
    (_, whole), (_, cut) = moved(1), moved(1, task="arrows:horizon=1")
    _, row = moved(1, reproducible=False)
    ((long,), (short,), (episode,)) = (each["episodes"] for each in (whole, cut, row))
    assert len(long["actions"]) > 1 and long["success"]
    assert (short["actions"], short["states"], short["success"]) == (long["actions"][:1], long["states"][:1], False)
    assert (episode["success"], episode["reproducible"]) == (False, False)
    forged = {**row, "episodes": [{**episode, "success": True}]}
    *taken, refused = ask([{"kind": "row", "row": each} for each in (cut, row, forged)])
    assert taken == [1, 1] and "claims another end" in refused["refused"]


@pytest.mark.usefixtures("made")
def test_rows_of_the_board_are_on_the_page(tmp_path: Path) -> None:
    import rows

    board = tmp_path / "board"
    names = ("expert-motion-arrow_puzzle", "random-f2c325a69092")
    for name in names:
        shutil.copytree(rows.BOARD / name, board / name)
    rows.write(tmp_path / "out", board)
    written = dict(json.loads((tmp_path / "out" / "index.json").read_text()))
    assert written == {name: json.loads((tmp_path / "out" / f"{name}.json").read_text())["title"] for name in names}
    assert written[names[0]].endswith("20 of 20 solved")
    episodes = board / names[0] / "episodes.json"
    episodes.write_text(episodes.read_text().replace('"solved":true', '"solved":false', 1))
    with pytest.raises(ArtefactError):
        rows.write(tmp_path / "again", board)


@needs_node
@pytest.mark.slow  # torch, an encoder and MuJoCo's renderer load
@pytest.mark.usefixtures("made")
def test_the_model_gives_torchs_numbers(tmp_path: Path) -> None:
    import world_model

    model = world_model.rounded(world_model.untrained(400))
    (tmp_path / "model.bin").write_bytes(world_model.packed(model))
    assert (tmp_path / "model.bin").stat().st_size <= 3_000_000
    frames = world_model.frames()
    rng = np.random.default_rng(400)
    asked = [(int(rng.integers(len(frames))), int(rng.integers(6))) for _ in range(24)]
    opaque = np.full((64, 64, 1), 255, dtype=np.uint8)
    questions = [
        {
            "kind": "model", "path": str(tmp_path / "model.bin"), "action": action,
            "rgba": np.concatenate([frames[row], opaque], axis=-1).ravel().tolist(),
        }
        for row, action in asked
    ]  # fmt: skip
    for found, (row, action) in zip(ask(questions), asked, strict=True):
        wanted = world_model.expected(model, frames[row], action)
        for name in ("latents", "next", "disagreement", "reward", "ends"):
            np.testing.assert_allclose(found[name], wanted[name], atol=1e-3, rtol=0, err_msg=name)
        image = np.asarray(wanted["image"]).ravel()
        np.testing.assert_allclose(found["image"], image, atol=1e-3, rtol=0)
    assert sys.float_info.epsilon < float(np.ptp([each["reward"] for each in ask(questions[:2])])), "all answers equal"
