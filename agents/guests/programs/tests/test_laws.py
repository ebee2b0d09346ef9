"""Laws: the shortest that explain transitions, and their writer's experience beside the cautious learner's."""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from imagine_bench_programs import __main__ as commands
from imagine_bench_programs.__main__ import written
from imagine_bench_programs.agent import LawsAgent, ProgramAgent
from imagine_bench_programs.model import SymbolModel, WrittenModel
from imagine_bench_programs.program import Program
from imagine_bench_programs.symbols import Symbols
from imagine_bench_programs.writing.delay import CodedRow
from imagine_bench_programs.writing.laws import Laws, _completed, _cover, ends_of, simplest
from imagine_bench_programs.writing.writer import Writer
from numpy.typing import NDArray

from imagine_bench import registry
from imagine_bench.exact.certificate import certificate
from imagine_bench.interfaces import AgentContext, Frame, Observation, State, Transition
from imagine_bench.interfaces.episodes import joined
from imagine_bench.seeding import SeedTree
from imagine_bench.sweep.grid import GRIDS, SUITE

KEPT = Path(__file__).parents[4] / "docs" / "results" / "programs" / "written.json"


@pytest.mark.parametrize(
    ("came", "failed", "chance"),
    [(0, 0, 1.0), (5, 0, 1.0), (0, 5, 0.0), (83, 17, 0.8), (9_500, 500, 0.95)],
)
def test_a_probability_has_as_few_decimals_as_counts_allow(came: int, failed: int, chance: float) -> None:
    assert simplest(came, failed)[0] == pytest.approx(chance)


def row(
    now: tuple[int, ...], then: tuple[int, ...], action: int = 0, reward: float = 0.0, ended: bool = False
) -> CodedRow:
    return CodedRow(now, action, then, reward, ended)


def test_a_step_round_the_circle_is_shorter_than_a_table() -> None:
    laws = Laws((4,), 1, [row((value,), (value + 1,)) for value in range(3)])
    assert laws.turned((3,), 0) == (0,), "a value that was never seen turns as the others do"


def test_a_permutation_is_shorter_than_a_table_and_completes_itself() -> None:
    turns = {2: 0, 0: 3, 3: 1}  # no step round the circle; where 1 goes was never seen
    laws = Laws((4,), 1, [row((value,), (after,)) for value, after in turns.items()] * 2)
    assert laws.turned((1,), 0) == (2,) and not laws.drifts
    presses = [row((value,), (max(value, 1),)) for value in range(4) for _ in range(3)]
    assert [Laws((4,), 1, presses).turned((value,), 0)[0] for value in range(4)] == [1, 1, 2, 3]


def test_macro_actions_that_undo_each_other_share_what_was_seen() -> None:
    turns = {0: 2, 2: 3, 3: 1, 1: 0}
    there = [row((0,), (2,), 0)]
    back = [row((turns[value],), (value,), 1) for value in (0, 2)]
    laws = Laws((4,), 2, [*there, *back] * 3)
    for value, after in turns.items():
        assert (laws.turned((value,), 0), laws.turned((after,), 1)) == ((after,), (value,))
    other = [row((0,), (1,), 1), row((1,), (3,), 1)]  # undoes nothing that was seen
    assert Laws((4,), 2, [*there, *other] * 3).turned((3,), 1) == (2,)
    ends = [row((value,), (min(value + 1, 2),), 0) for value in range(3)]
    ends += [row((value,), (max(value - 1, 0),), 1) for value in range(3)]
    laws = Laws((3,), 2, ends * 3)
    assert (laws.turned((2,), 0), laws.turned((0,), 1)) == ((2,), (0,)), "values that were seen to stay"


@pytest.mark.parametrize(("failed", "after"), [(7, 0), (8, 1)])
def test_a_macro_action_that_may_have_failed_by_chance_undoes_the_other_there_too(failed: int, after: int) -> None:
    """Six of ten work: seven failures are no surprise (0.0016), eight are one (0.0007)."""
    turns = [row((value,), ((value + turn) % 4,), 0) for value in range(4) for turn in (1,) * 6 + (0,) * 4]
    back = [row(each.then, each.now, 1) if each.now != each.then else each._replace(action=1) for each in turns]
    back = [each for each in back if each.now != (1,)]
    laws = Laws((4,), 2, [*turns, *back, *[row((1,), (1,), 1)] * failed])
    assert laws.turned((1,), 1) == (after,) and laws.turned((2,), 1) == (1,)


def test_a_permutation_makes_one_cycle_of_values_that_were_never_seen() -> None:
    assert [_completed(changed, 4) for changed in ({2: 0}, {0: 2, 3: 1}, {0: 1, 1: 0})] == [
        (3, 2, 0, 1),
        (2, 0, 3, 1),
        (1, 0, 3, 2),
    ]


def test_one_probability_for_all_actions_is_the_shorter_law() -> None:
    counts = [(41, 17), (34, 8), (41, 9), (35, 0), (41, 15), (38, 6)]  # of one exploration at slip=0.2
    rows = [
        row((value % 4,), ((value + turns) % 4,), action)
        for action, both in enumerate(counts)
        for turns, count in zip((1, 0), both, strict=True)
        for value in range(count)
    ]
    assert Laws((4,), len(counts), rows).happens == [pytest.approx(0.8)] * len(counts)
    certain = [row((value % 4,), ((value + 1) % 4,), 6) for value in range(60)]
    assert Laws((4,), 7, [*rows, *certain]).happens[6] == 1.0, "60 macro-actions that never failed are another matter"


def test_a_precondition_is_found_where_nothing_shorter_explains() -> None:
    every = itertools.product(range(3), range(2), range(2))
    rows = [row((a, b, c), ((a + 1) % 3 if (b, c) == (1, 0) else a, b, c)) for a, b, c in every]
    laws = Laws((3, 2, 2), 1, rows)
    assert all(laws.turned(each.now, 0) == each.then for each in rows)
    (law,) = laws.effects[0]
    assert {(test.place, test.value) for test in law.tests} == {(1, 1), (2, 0)}


def test_a_misread_image_becomes_no_law() -> None:
    """Two transitions differ by it: the one to the image, and the one from it."""
    rng = np.random.default_rng(0)
    actions = rng.integers(3, size=200)
    turned = np.vstack([np.zeros(3, dtype=int), np.cumsum(np.eye(3, dtype=int)[actions], axis=0)]) % 4
    for place in (60, 120):
        turned[place, (actions[place] + 1) % 3] += 2  # of a dial that its macro-action does not turn
    states = [tuple(state) for state in (turned % 4).tolist()]
    rows = [
        row(now, then, int(action)) for (now, then), action in zip(itertools.pairwise(states), actions, strict=True)
    ]
    lamp = [
        row((*each.now, int(place == 81)), (*each.then, int(place == 80)), each.action)
        for place, each in enumerate(rows)
    ]
    laws = Laws((4, 4, 4, 2), 3, lamp)
    assert not laws.drifts
    assert [[(law.factor, law.tests) for law in each] for each in laws.effects] == [[(dial, ())] for dial in range(3)]


@pytest.mark.parametrize(("kept", "becomes"), [(5, 1), (6, 0)])
def test_a_change_that_was_seen_once_is_a_law_where_little_else_was_seen(kept: int, becomes: int) -> None:
    others = [row((2, 0), (2, 0), 1)] * 40
    laws = Laws((4, 2), 2, [row((0, 0), (1, 0)), *[row((2, 0), (2, 0))] * kept, *others])
    assert laws.turned((0, 0), 0) == (becomes, 0)


def test_a_factor_that_changes_whatever_is_done_drifts() -> None:
    rng = np.random.default_rng(0)
    rows = []
    for _ in range(300):
        now = int(rng.integers(3))
        then = (now + int(rng.integers(1, 3))) % 3 if rng.random() < 0.2 else now
        rows.append(row((now,), (then,), action=int(rng.integers(4))))
    laws = Laws((3,), 4, rows)
    assert laws.drifts == {0: pytest.approx(0.2)} and not any(laws.effects)
    assert laws.superfluous == {0}
    assert sum(each.probability for each in laws.outcomes((0,), 1)) == pytest.approx(1.0)


def test_a_drift_stops_with_the_episode_and_is_no_failure_of_a_macro_action() -> None:
    """One macro-action turns a dial, and the end is where it turns to 0; a light flips by chance until then."""
    rng = np.random.default_rng(0)
    rows = []
    for number in range(800):
        dial, light, action = number % 4, int(rng.integers(3)), int(rng.integers(2))
        then = (dial + 1 - action) % 4
        ended = (dial, then) == (3, 0)
        flips = not ended and rng.random() < 0.3
        after = (light + flips * int(rng.integers(1, 3))) % 3
        rows.append(row((dial, light), (then, after), action, float(ended), ended))
    laws = Laws((4, 3), 2, rows)
    assert laws.drifts == {1: pytest.approx(0.3)} and laws.happens[0] == 1.0
    goes_on, ends = (
        {each.macrostate: (each.probability, each.reward, each.terminated) for each in laws.outcomes((dial, 1), 0)}
        for dial in (0, 3)
    )
    assert {state: each[0] for state, each in goes_on.items()} == pytest.approx(
        {(1, 0): 0.15, (1, 1): 0.7, (1, 2): 0.15}
    )
    assert ends == {(0, 1): (1.0, 1.0, True)}


USES: dict[str, Callable[[State, State], bool] | None] = {
    "no law": lambda now, then: then[0] == 0,
    "a symbol after": lambda now, then: then[1] == 1,
    "a symbol before": lambda now, then: now[1] == 1,
    "two symbols that are alike": lambda now, then: then[0] == then[1],
    "an effect": None,
}
"""Where laws use a factor that drifts: by which symbols there is a reward, or in an effect instead."""


@pytest.mark.parametrize("used", USES)
def test_a_factor_on_which_a_law_depends_is_not_superfluous(used: str) -> None:
    rewarded = USES[used]
    rng = np.random.default_rng(0)
    rows = []
    for _ in range(300):
        now = (int(rng.integers(3)), int(rng.integers(3)))
        drifted = (now[1] + int(rng.random() < 0.3) * int(rng.integers(1, 3))) % 3
        turns = rewarded is not None or now[1] == 2
        then = ((now[0] + int(turns)) % 3, drifted)
        rows.append(row(now, then, reward=float(rewarded is not None and rewarded(now, then))))
    laws = Laws((3, 3), 1, rows)
    assert laws.drifts.keys() == {1}
    assert all(laws.end(each.now, 0, each.then).reward == each.reward for each in rows)
    assert all(laws.turned(each.now, 0)[0] == each.then[0] for each in rows)
    assert laws.superfluous == ({1} if used == "no law" else set())


def test_ends_say_two_equal_values_in_one_condition() -> None:
    rows = [row((a, b), (a, b), reward=-float(a == b), ended=a == b) for a in range(4) for b in range(4)]
    alike, usual = ends_of(rows, (4, 4), 1)
    assert (len(alike.tests), alike.tests[0].alike, alike.reward, alike.ended) == (1, True, -1.0, True)
    assert usual.tests == () and not usual.ended


def test_a_law_that_later_ones_make_superfluous_is_left_out() -> None:
    holds = np.array([[1, 1, 1, 1, 0, 0], [1, 1, 0, 0, 1, 0], [0, 0, 1, 1, 0, 1]], dtype=bool)
    assert _cover(holds, np.ones(6, dtype=bool)) == [(1,), (2,)]


def late(delay: int, episodes: int = 30) -> list[CodedRow]:
    """Of two macro-actions, which turn a dial of five values, with symbols that are late; turning to 0 ends it."""
    rng = np.random.default_rng(3)
    rows = []
    for _ in range(episodes):
        states = [int(rng.integers(1, 5))]
        for step in range(8):
            action = int(rng.integers(2))
            states.append((states[-1] + (1, 3)[action]) % 5)
            shown = [states[max(0, each - delay)] for each in (step, step + 1)]
            done = states[-1] == 0
            rows.append(CodedRow((shown[0],), action, (shown[1],), float(done), done, step))
            if done:
                break
    return rows


@pytest.mark.parametrize("delay", [0, 1, 2, 3])
def test_late_symbols_give_the_laws_of_those_that_are_not(delay: int) -> None:
    rows = late(delay)
    laws = Laws((5,), 2, rows)
    assert laws.delay == delay and not laws.drifts
    turns = [[laws.turned((value,), action)[0] for value in range(5)] for action in range(2)]
    assert turns == [[1, 2, 3, 4, 0], [3, 4, 0, 1, 2]]
    for each in laws.present(rows):
        assert laws.end(each.now, each.action, each.then)[1:] == (each.reward, each.ended)
    assert {laws.end((value,), 0, laws.turned((value,), 0)).ended for value in range(4)} == {False}
    assert laws.end((4,), 0, (0,)).ended, "the reward that came at once belongs to symbols that are not seen yet"


def test_a_new_delay_counts_all_tries_again() -> None:
    """And a value that was not seen teaches nothing."""
    writer, again = (Writer((5,), 2, np.random.default_rng(0)) for _ in range(2))
    writer.learn(row((0,), (-1,)))
    writer.write()
    assert writer.laws.count == 0
    rows = iter(late(1))
    while not writer.laws.delay:
        writer.learn(next(rows))
    again.take_up(writer.sizes, writer.rows)
    assert writer.laws.delay == again.laws.delay == 1 and writer._tried == again._tried


@pytest.mark.parametrize(("tries", "known"), [(7, False), (8, True)])
def test_a_macro_action_is_tried_until_it_cannot_have_failed_by_chance_alone(tries: int, known: bool) -> None:
    writer = Writer((2,), 2, np.random.default_rng(0))
    presses = [row((value,), (1 - value,)) for value in range(2)] * 6 + [
        row((value,), (value,)) for value in range(2)
    ] * 4
    writer.take_up((2,), [*presses, *[row((1,), (1,), 1)] * 20, *[row((0,), (0,), 1)] * tries])
    assert writer.laws.happens == [pytest.approx(0.6)] * 2
    chosen = set()
    for _ in range(20):
        writer.begin_episode()
        chosen.add(writer.explore((0,)))
    assert chosen == ({0, 1} if known else {1})


def test_more_macro_actions_are_another_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands, "_learner", lambda spec: 20.0)
    out = tmp_path / "new" / "written.json"
    for times in ("1", "2", "1"):
        words = ["programs", "write", "arrow_puzzle_easy", "--seeds", "1", "--times", times, "--out", str(out)]
        monkeypatch.setattr(sys, "argv", words)
        commands.main()
    assert [each["macro_actions"] for each in json.loads(out.read_text())["rows"]] == [20, 40]


def test_a_task_seed_and_appearance_are_one_row_however_often_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Repeated rows would count as seeds of their own."""
    monkeypatch.setattr(commands, "_learner", lambda spec: 20.0)
    monkeypatch.setattr(commands, "written", lambda spec, budget, seed, look, own: {"seed": seed, "macro_actions": 20})
    out = tmp_path / "written.json"
    for look in ("light=0.5,camera=0.2", "camera=0.2,light=0.50"):
        words = ["programs", "write", *["arrow_puzzle_easy"] * 2, "--seeds", "1", "2", "1", "--times", "1"]
        monkeypatch.setattr(sys, "argv", [*words, "--codes", look, "--out", str(out)])
        commands.main()
    found = [(each["codes"], each["seed"]) for each in json.loads(out.read_text())["rows"]]
    assert found == [("light=0.5,camera=0.2", 1), ("light=0.5,camera=0.2", 2)]


_HARDER = ("arrows:slip=0.2", "arrows:horizon=5,gesture=first", "arrows:horizon=6,lag=2")


@pytest.mark.parametrize("name", ["arrow_puzzle", *(pytest.param(name, marks=pytest.mark.slow) for name in _HARDER)])
def test_the_writer_is_exact_after_twice_the_cautious_cost(name: str) -> None:
    spec = registry.task(name)
    cost = certificate(spec).learning_cost
    assert cost is not None
    assert written(spec, int(2 * cost.transitions), seed=7)["total_variation"] < 0.005


@pytest.mark.slow  # an encoder reads hundreds of images, one at a time
def test_the_writer_is_exact_from_codes_too() -> None:
    found = written(registry.task("arrow_puzzle"), 224, seed=7, appearance="clean")
    assert found["total_variation"] < 0.005 and found["ranking"] == found["fidelity"] == 1.0


class ByteSymbols(Symbols):
    """The code of a frame is its first two bytes; a probe adds 10."""

    def __init__(self, sizes: tuple[int, ...] = (3, 2)) -> None:
        self.sizes = sizes

    def read(self, frames: Frame) -> list[State]:
        return [tuple(each) for each in frames[:, 0, 0, : len(self.sizes)].tolist()]

    def macrostates(self, states: Sequence[State]) -> NDArray[np.int64]:
        return np.array(states) + 10

    def images(self, states: Sequence[State]) -> NDArray[np.uint8]:
        return np.array(states, dtype=np.uint8)[:, None]


def test_the_agents_expectations_are_those_of_its_laws() -> None:
    context = AgentContext(n_actions=2, preprocessing="none", encoder=None, seeds=SeedTree(0))
    agent = LawsAgent(ByteSymbols(), context)
    every = [(a, b) for a in range(3) for b in range(2)]
    rows = [row((a, b), ((a + 1) % 3, b), 0, reward=5.0 * b, ended=b == 1) for a, b in every]
    flips = [(a, b, after) for a, b in every for after in range(2) for _ in range(5)]
    rows += [row((a, b), (a, after), 1, reward=float(after)) for a, b, after in flips]
    agent.writer.laws = Laws((3, 2), 2, rows)
    frames = np.zeros((2, 64, 64, 3), dtype=np.uint8)
    frames[1, 0, 0, :2] = (2, 1)
    np.testing.assert_array_equal(agent.read_frames(frames), [[10, 10], [12, 11]])
    found = agent.predict_outcomes(frames, np.random.default_rng(0))
    branches = zip(found.macrostates.reshape(4, -1, 2).tolist(), found.p_continues.reshape(4, -1).tolist(), strict=True)
    expected = [{tuple(place): share for place, share in zip(*each, strict=True) if share} for each in branches]
    assert expected == [{(11, 10): 1.0}, {(10, 11): 0.5, (10, 10): 0.5}, {}, {(12, 10): 0.5, (12, 11): 0.5}]
    np.testing.assert_array_equal(found.reward, [[0.0, 0.5], [5.0, 0.5]])


def test_what_a_program_remembers_goes_with_the_state_until_the_episode_ends(tmp_path: Path) -> None:
    """A count of steps, whose parity says which macro-action pays in the next; the program ends after two."""
    file = tmp_path / "counts.py"
    pays = "def outcomes(s, a, m):\n n = (m or 0) + 1\n return {((1,), float(a == n % 2), n > 1, n): 1.0}\n"
    file.write_text(pays)
    counts = Program(str(file), (2,), 2)
    once = counts.follow(counts.start((0,)), 0, (1,))
    assert not counts.outcomes(counts.start((0,)), 0)[0].terminated and counts.outcomes(once, 0)[0].terminated
    assert counts.follow(once, 0, (0,)) == counts.start((0,)), "an unexpected symbol forgets"
    agent = ProgramAgent(ByteSymbols((2,)), counts)
    seen = Observation(frame=np.ones((64, 64, 3), dtype=np.uint8))
    for _ in range(2):
        agent.begin_episode()
        assert [agent.act(seen, explore=False) for _ in range(3)] == [1, 0, 1]
    shown = np.zeros((1, 2, 64, 64, 3), dtype=np.uint8)
    shown[0, 1] = 1
    for frames, actions in ((shown, [[0, 0]]), (shown[:, 1:], [[1, 0]])):  # a step of memory is shown, or imagined
        found = SymbolModel(ByteSymbols((2,)), counts).imagine(frames, np.array(actions), 1, np.random.default_rng(0))
        assert found.rewards is not None and found.rewards[0, 0, -1] == found.p_ended[0, 0, -1] == 1.0


def test_the_laws_of_a_dataset_are_those_of_its_transitions() -> None:
    """Of several episodes, whose symbols are late; each begins anew."""
    rows = late(1)
    episodes: list[dict[str, Any]] = []
    for each in rows:
        if each.step == 0:
            episodes.append({"frames": [each.now], **{name: [] for name in ("actions", "rewards", "terminated")}})
        seen = {"frames": each.then, "actions": each.action, "rewards": each.reward, "terminated": each.ended}
        for name, value in seen.items():
            episodes[-1][name].append(value)
    for each in episodes:
        ends = each["terminated"]
        frames = np.array(each["frames"], dtype=np.uint8)[:, None, None].repeat(64, 1).repeat(64, 2).repeat(3, 3)
        masks = np.ones((len(frames), 2), dtype=np.int8)
        cut = [*[False] * (len(ends) - 1), not ends[-1]]
        each |= {"frames": frames, "action_masks": masks, "truncated": cut, "success": ends[-1]}
    model = WrittenModel(ByteSymbols((5,)), Laws((5,), 2))
    model.fit(joined(episodes), np.random.default_rng(0))
    laws, found = Laws((5,), 2, rows), model.rules
    assert isinstance(found, Laws) and (found.nats, found.delay, found.ends) == (laws.nats, 1, laws.ends)
    assert model.parameters() == laws.count


def test_plans_begin_after_the_macro_actions_of_this_episode() -> None:
    """Frames are a macro-action late. The second macro-action ends the episode from 2, the first one from 4."""
    context = AgentContext(n_actions=2, preprocessing="none", encoder=None, seeds=SeedTree(0))
    agent = LawsAgent(ByteSymbols((5,)), context)
    frames = [np.full((64, 64, 3), value, dtype=np.uint8) for value in range(5)]
    for number, each in enumerate(late(1, episodes=40)):
        if each.step == 0:
            agent.begin_episode()
        seen, then = (Observation(frame=frames[value]) for (value,) in (each.now, each.then))
        transition = Transition(
            observation=seen,
            action=each.action,
            reward=each.reward,
            next_observation=then,
            terminated=each.ended,
            truncated=each.step == 7 and not each.ended,
        )
        agent.observe(transition, episode=number)
    resumed = LawsAgent(ByteSymbols((5,)), context)
    resumed.restore(agent.state())
    for who in (agent, resumed):
        assert who.writer.rows == late(1, episodes=40) and who.writer.laws.delay == 1
        who.begin_episode()
        assert [who.act(Observation(frame=frames[3]), explore=False) for _ in range(2)] == [0, 0]
        who.begin_episode()
        assert who.act(Observation(frame=frames[2]), explore=False) == 1, "nothing is on its way yet"
        who.begin_episode()
        both = {who.act(Observation(frame=frames[1]), explore=False) for _ in range(2)}
        assert both == {0, 1}, "the second begins where the first leads, which no frame shows yet"


@pytest.mark.parametrize(("own", "experiments"), [(False, 11), (True, 10)])
def test_kept_programs_are_as_exact_as_the_page_says(own: bool, experiments: int) -> None:
    every = json.loads(KEPT.read_text())["rows"]
    assert all(each["macro_actions"] <= 2 * each["learner"] for each in every)
    exact = []
    for experiment in GRIDS[SUITE].experiments:
        worlds = {
            (level.task, f"own {level.protocol.get('appearance', 'clean')}" if own else "")
            for level in experiment.levels
        }
        of_levels = [each["total_variation"] for each in every if (each["task"], each["codes"]) in worlds]
        exact.append(bool(of_levels) and np.mean(of_levels) < 0.005)
    assert sum(exact) == experiments
