"""Perception learned while acting: factors in images of a tiny world, and an agent that begins with nothing."""

from __future__ import annotations

import itertools
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from fake_codes import ACTIONS, drawn, starts
from fake_pictures import Code, agent, picture, played, shape
from imagine_bench_factored.factors import CodeTransition, Memory, remembering
from imagine_bench_factored.learned import LearnedPerceptionAgent, merges
from imagine_bench_factored.perception import FrameCodes, LearnedPerception
from imagine_bench_factored.seeing import appearance
from imagine_bench_factored.settings import LearnedPerceptionSettings
from numpy.typing import NDArray

from imagine_bench.interfaces import AgentState, Frame, Observation, Transition
from imagine_bench.seeding import SeedTree


def walk(steps: int, rng: np.random.Generator) -> tuple[list[Code], Frame]:
    """The first codes of random episodes, and pictures of them."""
    codes = [row.code for _ in range(steps) for row in drawn(rng)][:steps]
    return codes, np.stack([picture(code, rng) for code in codes])


def live(learner: LearnedPerceptionAgent, episodes: range, seed: int) -> list[int]:
    """Train on pictures of the tiny world; each episode is drawn from its own seed. The actions taken."""
    taken = []
    for episode in episodes:
        for transition in played(learner, np.random.default_rng((seed, episode)), explore=True):
            learner.observe(transition, episode=episode)
            taken.append(transition.action)
    return taken


EPISODES = 40


Trained = tuple[LearnedPerceptionAgent, list[int], list[int]]


@pytest.fixture(scope="module")
def trained() -> Trained:
    """An agent that began with nothing, after forty episodes; tests leave it as it is.

    And its actions, and how many episodes had begun whenever its perception changed.
    """
    learner, taken, begun = agent(), [], []
    for episode in range(EPISODES):
        taken += live(learner, range(episode, episode + 1), seed=0)
        begun += [episode + 1] * (len(learner.perception.history) - len(begun))
    return learner, taken, begun


def gray(count: int) -> Frame:
    """Frames in which nothing is to be seen."""
    return np.full((count, 64, 64, 3), 120, dtype=np.uint8)


def show(frames: Frame, where: Any, kind: int, top: int = 20) -> None:
    """Let some frames show a mark."""
    frames[where, top : top + 12, top : top + 12] += (100 * shape(kind))[..., None].astype(np.uint8)


def pairs(values: NDArray[np.int64], truth: NDArray[np.int64]) -> int:
    """How many pairs of found and true values there are: as many as values if each names the other."""
    return len(set(zip(values.tolist(), truth.tolist(), strict=True)))


def told_apart(
    frames: Frame, begins: NDArray[np.bool_] | None = None, actions: NDArray[np.int64] | None = None
) -> tuple[list[int], NDArray[np.int64]]:
    """How many values each factor has that is found in frames, and the codes of these frames; all are known."""
    found = appearance.find(frames, begins, actions)
    codes, known, _ = appearance.read(found, frames)
    assert known.all()
    return [len(factor.joint) for factor in found], codes


def test_factors_and_values_are_found_in_few_frames_of_its_own() -> None:
    """One value a shape, whatever the jitter and tint: codes of fresh pictures and true codes name each other."""
    _, frames = walk(60, np.random.default_rng(0))
    found = appearance.find(frames)
    assert sorted(len(factor.joint) for factor in found) == [2, 3, 3]
    truth, fresh = walk(300, np.random.default_rng(1))
    codes, known, _ = appearance.read(found, fresh)
    named = set(zip(map(tuple, codes.tolist()), truth, strict=True))
    assert len(named) == len({code for code, _ in named}) == len(set(truth)) > 6
    assert known.mean() > 0.98


def test_where_nothing_happens_nothing_is_found() -> None:
    rng = np.random.default_rng(0)
    still = gray(20)
    assert appearance.find(still) == [] and appearance.find(still[:1]) == []
    tinted = (still * rng.uniform(0.5, 1.0, size=(20, 1, 1, 3))).astype(np.uint8)
    assert appearance.find(tinted) == [], "light is no factor"


def test_pieces_that_hardly_part_are_one_factor() -> None:
    """Two bars two pixels apart, each too small for a factor, of which never one follows the other at once."""
    shown = np.where(np.arange(60) % 2, np.random.default_rng(0).integers(1, 3, size=60), 0)
    frames = gray(60)
    frames[shown == 1, 20:27, 20:22] = frames[shown == 2, 20:22, 24:31] = 220
    sizes, codes = told_apart(frames)
    assert len(sizes) == 1 and pairs(codes[:, 0], shown) == 3


@pytest.mark.parametrize(("top", "found"), [(30, 1), (0, 0), (59, 0)])
def test_a_small_thing_is_a_factor_unless_the_border_cuts_it(top: int, found: int) -> None:
    """Five by five pixels; a sliver that comes into view at the border is as small, and no thing."""
    frames = gray(60)
    frames[np.random.default_rng(0).random(60) < 0.5, top : top + 5, 30:35] = 220
    assert len(appearance.find(frames)) == found


@pytest.mark.parametrize(("matters", "told", "rare"), [(True, False, 1), (False, True, 1), (True, True, 4)])
def test_what_is_nearly_alike_is_parted_where_that_tells_what_follows(matters: bool, told: bool, rare: int) -> None:
    """Three marks in a ring, of which macro-actions show the next or the last; two are nearly alike.

    They are one value if no action is known, or if it is chance which of them is shown (then there are two in truth).
    ``rare``: of so many macro-actions one does something; all frames tell, not only those that are grouped.
    """
    rng = np.random.default_rng(0)
    count = 120 * rare
    actions = np.where(np.arange(count) % rare == 0, rng.integers(2, size=count), 2)
    place = np.concatenate([[0], np.array([-1, 1, 0])[actions[:-1]].cumsum()]) % (3 if matters else 2)
    shown = place if matters else np.where(place == 1, 2, rng.integers(2, size=count))
    frames = gray(count)
    frames[shown < 2, 20:40, 27:33] = frames[shown == 1, 20:29, 33:41] = frames[shown == 2, 28:34, 20:40] = 220
    actions[-1] = -1
    sizes, codes = told_apart(frames, None, actions if told else None)
    parted = pairs(codes[:, 0], shown) == sizes[0] == 3
    assert parted == (matters and told)


def test_the_likelihood_of_values_is_a_product_of_predictions() -> None:
    """Laplace's rule, one after the other: (1 + times seen so far) / (values + times of that context so far)."""
    rng = np.random.default_rng(0)
    values, actions, following = rng.integers(3, size=(3, 40))
    product, seen = 1.0, np.zeros((3, 3, 3))
    for value, action, after in zip(values, actions, following, strict=True):
        product *= (1.0 + seen[value, action, after]) / (3.0 + seen[value, action].sum())
        seen[value, action, after] += 1.0
    assert appearance.follows(values, actions, following) == pytest.approx(np.log(product))


def test_merging_values_costs_what_they_told_of_the_next_ones() -> None:
    """A wheel of four places that turns or stays, and a lamp; merged are two places, or two looks of one place."""
    rng = np.random.default_rng(0)
    actions = rng.integers(2, size=61)
    place = np.concatenate([[0], actions[:-1].cumsum()]) % 4
    look = rng.integers(2, size=61)  # of a place, by chance
    lamp = rng.integers(3, size=61)
    merged = np.maximum(place - 1, 0)
    true = np.stack([place, lamp], axis=1)

    def lost(finer: NDArray[np.int64], coarser: NDArray[np.int64]) -> float:
        return appearance.lost_by_merging(finer[:-1], coarser[:-1], actions[:-1], coarser[1:])

    told, left = (appearance.follows(values[:-1], actions[:-1], merged[1:]) for values in (place, merged))
    assert lost(true, np.stack([lamp, merged], axis=1)) == pytest.approx(told - left) and told > left
    assert lost(np.stack([2 * place + look, lamp], axis=1), true) < 0.0, "looks tell nothing"
    assert lost(true, np.stack([lamp, (place + 1) % 4], axis=1)) == 0.0, "the same by other names"
    assert lost(true, merged[:, None]) == 0.0, "not a factor less"
    both = np.stack([merged, 2 * lamp + look], axis=1)
    assert lost(true, both) == 0.0, "another factor is split"
    finest = 2 * place + look
    three = lost(np.stack([finest, place, lamp], axis=1), np.stack([lamp, merged, finest], axis=1))
    assert three == pytest.approx(told - left), "merged from the coarsest factor that tells it"


def test_values_tried_with_different_actions_lose_nothing_by_merging() -> None:
    """To the bit, however they are numbered: rounding decides nothing."""
    rng = np.random.default_rng(0)
    actions, after = rng.integers(9, size=(2, 200))
    for _ in range(100):
        finer, coarser = rng.permutation(9)[actions], np.zeros(200, dtype=np.int64)
        assert appearance.lost_by_merging(*(each[:, None] for each in (finer, coarser)), actions, after[:, None]) == 0.0


@pytest.mark.parametrize("unclear", ["code_is_clear", "following_is_clear"])
def test_only_clear_transitions_tell_whether_values_are_merged(unclear: str) -> None:
    """A wheel of three places that an action turns; the last row alone says that one place has two names."""
    places = np.arange(31) % 3

    def rows(values: NDArray[np.int64]) -> list[CodeTransition]:
        return [CodeTransition((a,), 0, (b,), -1.0, terminated=False) for a, b in pairwise(values.tolist())]

    earlier, present = rows(places), rows(np.minimum(places, 1))
    odd = earlier[0]._replace(code=(1,), following=(0,)), present[0]._replace(code=(0,), following=(1,))
    assert merges(earlier, present) and not merges(present, earlier) and not merges([], [])
    assert not merges([*earlier, odd[0]], [*present, odd[1]])
    for side in (0, 1):
        last = [row._replace(**{unclear: place != side}) for place, row in enumerate(odd)]
        assert merges([*earlier, last[0]], [*present, last[1]])


def test_what_changes_only_between_episodes_is_a_factor_too() -> None:
    """A mark at one of four places at the start of episodes of 25 frames: seldom in all, but often there."""
    rng = np.random.default_rng(0)
    places = np.repeat(rng.permutation(np.arange(24) % 4), 25)
    frames = gray(600)
    for frame, place in zip(frames, places, strict=True):
        frame[20:32, 8 + 12 * place : 16 + 12 * place] = 220
    assert appearance.find(frames) == [], "no pixel changes in 3 % of all steps"
    _, codes = told_apart(frames, np.arange(600) % 25 == 0)
    assert len(np.unique(codes, axis=0)) == len(np.unique(np.column_stack([codes, places]), axis=0)) == 4


def test_what_is_seen_once_in_twenty_frames_is_a_value() -> None:
    """Where most crops of a region have no contour at all."""
    frames = gray(60)
    show(frames, [5, 20, 40], 0)
    _, codes = told_apart(frames)
    assert np.argwhere(codes).tolist() == [[5, 0], [20, 0], [40, 0]]


def test_the_widest_gap_parts_the_groups() -> None:
    rng = np.random.default_rng(0)
    truth = rng.integers(3, size=30)
    apart = np.where(truth[:, None] == truth, rng.uniform(0.05, 0.2, (30, 30)), rng.uniform(0.4, 0.5, (30, 30)))
    label, cut = appearance.groups(apart)
    assert pairs(label, truth) == 3 and 0.15 < cut < 0.45
    assert not appearance.groups(0.1 * (1.0 - np.eye(30)))[0].any(), "jitter alone makes one group"


def test_frequent_changes_are_a_factor_after_any_pause() -> None:
    """In 2.5 % of the steps, the share of one of many things; a thing that changed half as often is none yet."""
    frames = gray(800)
    show(frames, slice(40, None, 80), 0)
    show(frames, slice(80, None, 160), 1, top=40)
    (found,) = appearance.find(frames)
    assert len(found.joint) == 2 and found.parts[0].mask[20:32, 20:32].any()


def test_a_faint_edge_in_an_empty_place_is_no_value() -> None:
    """A sliver of a neighbour has contours, but hardly any beside those of objects that may lie there."""
    value = np.arange(90) % 3  # nothing, or one of two marks
    frames = gray(90)
    for kind in (0, 1):
        show(frames, value == kind + 1, kind)
    frames[(value == 0) & (np.arange(90) % 2 == 0), 20:32, 20:21] += 50
    sizes, codes = told_apart(frames)
    assert sizes == [3] and pairs(codes[:, 0], value) == 3


class _Doubtful(LearnedPerception):
    """Is unsure of frames whose first pixel is black."""

    def codes(self, frames: Frame) -> FrameCodes:
        return super().codes(frames)._replace(clear=frames[:, 0, 0].any(axis=-1))


def doubtful_agent() -> LearnedPerceptionAgent:
    settings = agent().settings
    return LearnedPerceptionAgent(_Doubtful(settings.perception, factored=True), ACTIONS, settings, SeedTree(0))


def doubtful(transition: Transition, *, before: bool, after: bool) -> Transition:
    """A transition whose frames are as clear as is told."""
    seen = []
    for observation, is_clear in ((transition.observation, before), (transition.next_observation, after)):
        frame = observation.frame.copy()
        frame[0, 0] *= is_clear
        seen.append(Observation(frame=frame))
    return replace(transition, observation=seen[0], next_observation=seen[1])


def test_a_transition_is_clear_if_both_of_its_frames_are() -> None:
    """Also once factors were found anew, and in a snapshot; no other is a surprise, from which it learns."""
    rng = np.random.default_rng(0)
    learner, again = doubtful_agent(), doubtful_agent()
    clear, surprised = [], []
    for episode in range(12):
        for transition in played(None, rng):
            before, after = (rng.random(2) >= 0.2).tolist()
            learner.observe(doubtful(transition, before=before, after=after), episode=episode)
            clear.append((before, after))
            surprised.append(learner.diagnostics()["model/unexpected"] > 0.0)
    assert {all(each) for each, surprise in zip(clear, surprised, strict=True) if surprise} == {True}
    assert len(learner.perception.history) > 2
    assert [(row.code_is_clear, row.following_is_clear) for row in learner.replay] == clear
    assert [row.is_clear for row in learner.replay] == [all(each) for each in clear]
    again.restore(learner.state())
    assert again.replay == learner.replay


def test_memory_takes_values_of_clear_frames_alone() -> None:
    """The codes that it acts on are those that it learns from."""
    rng = np.random.default_rng(0)
    learner = doubtful_agent()
    eyes = learner.perception
    for episode in range(12):
        for transition in played(None, rng):
            learner.observe(doubtful(transition, before=True, after=True), episode=episode)
    lamp = eyes.seen_sizes.index(2)
    for hidden in (0, 1):
        eyes.memory = Memory(lamp, hidden)
        lived, rows, begins = [], [], []
        for _ in range(12):
            eyes.begin_episode()
            is_clear = rng.random() >= 0.4
            for step, transition in enumerate(played(None, rng)):
                begins.append(step == 0)
                clear = [is_clear, bool(rng.random() >= 0.4)]
                seen = doubtful(transition, before=clear[0], after=clear[1])
                frames = (seen.observation.frame, seen.next_observation.frame)
                codes = [eyes.code(frame) for frame in frames]
                lived.append([code[-1] for code in codes])
                bare = CodeTransition(codes[0][:-1], 0, codes[1][:-1], 0.0, False)
                rows.append(bare._replace(code_is_clear=clear[0], following_is_clear=clear[1]))
                is_clear = clear[1]
        found = remembering(rows, begins, eyes.memory)
        assert [[row.code[-1], row.following[-1]] for row in found] == lived
        of_all = [row._replace(code_is_clear=True, following_is_clear=True) for row in rows]
        assert [row[:3] for row in remembering(of_all, begins, eyes.memory)] != [row[:3] for row in found]


def test_a_look_that_was_never_seen_is_unknown() -> None:
    rng = np.random.default_rng(0)
    codes, frames = walk(80, rng)
    without = np.array([code[0] != 2 for code in codes])
    found = appearance.find(frames[without])
    _, known, _ = appearance.read(found, frames)
    wheel = int(np.argmin(known[~without].mean(axis=0)))
    assert known[~without][:, wheel].mean() < 0.1 and known[without].all(axis=1).mean() > 0.95


def seeing_all(growth: float, growth_if_known: float) -> tuple[LearnedPerception, Frame]:
    """A perception that found factors in 16 frames, and these frames."""
    _, frames = walk(16, np.random.default_rng(0))
    eyes = LearnedPerception(LearnedPerceptionSettings(growth=growth, growth_if_known=growth_if_known), factored=True)
    for begins, (before, after) in enumerate(pairwise(frames)):
        eyes.remember(before, 0, after, begins=not begins)
    eyes.look(len(eyes.frames))
    return eyes, frames


def test_a_resumed_perception_is_renewed_as_soon_as_any() -> None:
    """Sooner once something had no known value: from 16 frames on with 20 (1.25), and from these with 23 (1.125)."""
    eyes, frames = seeing_all(1.125, 1.25)
    resumed, _ = seeing_all(1.125, 1.25)
    for count in range(17, 24):
        eyes.remember(eyes.frames[-1], 1, frames[count % 2] if count <= 20 else gray(1)[0])
        arrays = {**eyes.arrays(), "replay/action": np.array(eyes.actions)}
        resumed.load(AgentState(arrays=arrays, values=dict(eyes.values())))
        assert resumed.values() == eyes.values() and eyes.unknown == (count > 20)
        assert eyes.renew() == resumed.renew() == (count in (20, 23))


@pytest.mark.parametrize(("unknown", "due"), [(None, 20), (17, 18), (18, 18), (19, 19)])
def test_one_unknown_frame_is_not_forgotten_before_factors_are_found_anew(unknown: int | None, due: int) -> None:
    """That frame may be any of the new ones: with it factors are found anew from 18 frames on (1.125), else with 20."""
    eyes, frames = seeing_all(1.125, 1.25)
    renewed = []
    for count in range(17, 21):
        eyes.remember(eyes.frames[-1], 1, gray(1)[0] if count == unknown else frames[count % 2])
        if not renewed and eyes.renew():
            renewed.append(count)
    assert renewed == [due] and len(eyes.frames) == 20


@pytest.mark.parametrize(("unknown", "anew"), [((), False), ((0,), True), ((1,), True), ((0, 1), True)])
def test_each_of_two_frames_that_begin_an_episode_may_be_the_unknown_one(unknown: tuple[int, ...], anew: bool) -> None:
    eyes, frames = seeing_all(1.125, 1.25)
    before, after = (gray(1)[0] if place in unknown else frames[place] for place in range(2))
    eyes.remember(before, 1, after, begins=True)
    assert eyes.renew() == anew


def test_shifted_and_dimmed_crops_are_alike_and_others_are_not() -> None:
    mask = np.zeros((64, 64), dtype=np.bool_)
    mask[16:48, 16:48] = True

    def crop(kind: int, down: int = 0, right: int = 0, gain: float = 1.0) -> NDArray[np.float32]:
        image = np.full((1, 64, 64, 3), 0.4, dtype=np.float32)
        image[0, 26 + down : 38 + down, 26 + right : 38 + right] += shape(kind)[..., None].astype(np.float32)
        return appearance.crops(appearance.contours(gain * image), mask)

    def distance(one: NDArray[np.float32], other: NDArray[np.float32]) -> float:
        return float(appearance.distances(one, other, mask, 1e-6)[0, 0])

    for moved in ((5, -5, 0.5), (-3, 4, 2.0)):
        assert distance(crop(0), crop(0, *moved)) == pytest.approx(0.0, abs=1e-4)
        assert distance(crop(0), crop(1, *moved)) > 0.5
    assert distance(crop(0), crop(0, 9)) > 0.2, "it is compared at shifts of up to five pixels"
    nothing = np.zeros_like(crop(0))
    assert distance(nothing, nothing) == 0.0, "two empty crops are alike"


def test_copies_of_a_thing_are_one_factor_whose_value_most_of_them_show() -> None:
    value = np.random.default_rng(0).integers(2, size=60)
    frames = gray(60)
    for top, kind in itertools.product((4, 26, 48), (0, 1)):
        show(frames, value == kind, kind, top)
    (factor,) = appearance.find(frames)
    assert len(factor.parts) == 3
    torn = np.stack([frames[value == kind][0] for kind in (0, 1)])
    whole = appearance.read([factor], torn)
    torn[:, :22] = torn[::-1, :22]  # the first of the three shows the other value
    values, known, _ = appearance.read([factor], torn)
    assert whole.known.all() and not known.any() and np.array_equal(values, whole.values)


@pytest.mark.parametrize(("times", "found"), [(8, 2), (3, 1)])
def test_what_a_habit_binds_for_a_time_is_two_things(times: int, found: int) -> None:
    """Two squares side by side change together for a time, and then apart, so often: by few changes nothing is told."""
    change = np.zeros((80, 64, 64), dtype=bool)
    change[:40:2, 20:30, 20:40] = True
    change[40 : 40 + times, 20:30, 20:30] = change[60 : 60 + times, 20:30, 30:40] = True
    assert len(appearance.regions(change, change.any(axis=0))) == found


def test_what_does_not_vary_freely_is_one_factor() -> None:
    one, other, turns = np.random.default_rng(0).integers(3, size=(3, 200))
    first, second = ((turns == each).astype(np.int64) for each in (1, 2))
    assert not appearance.bound(one, other)
    assert appearance.bound(one, (one + 1) % 3), "a copy"
    assert appearance.bound(one, (one > 0).astype(np.int64)), "a coarser copy"
    assert appearance.bound(first, second), "one excludes the other"
    assert not appearance.bound(first[:9], second[:9]), "chance may be why"


def test_it_learns_to_see_and_to_act_from_nothing(trained: Trained) -> None:
    """A random agent solves 14.5 % of the starts: an exact number, by enumeration."""
    learner, *_ = trained
    last = [list(played(learner, np.random.default_rng((1, episode)), explore=False))[-1] for episode in range(20)]
    found = learner.diagnostics()
    assert np.mean([transition.reward > 0.0 for transition in last]) >= 0.9
    assert (found["perception/factors"], found["perception/values"]) == (3, 8)


def test_remembered_transitions_get_their_frames_present_codes(trained: Trained) -> None:
    learner, *_ = trained
    eyes = learner.perception
    codes = eyes.codes(np.stack(eyes.frames)).values
    looked = [row for row in zip(learner.replay, eyes.transitions, strict=True) if row[1][1] < eyes.looked_at]
    assert looked
    assert all(row.code == codes[before] and row.following == codes[after] for row, (before, after) in looked)


def test_with_as_many_frames_as_it_may_remember_it_sees_as_before() -> None:
    learner = agent(perception__frames=20)
    live(learner, range(12), seed=0)
    eyes = learner.perception
    found, frames = eyes.found, len(eyes.frames)
    live(learner, range(12, 16), seed=0)
    assert eyes.full and frames == len(eyes.frames) <= 21 and eyes.found is found


def test_it_can_show_how_it_learned_to_see(trained: Trained) -> None:
    """As often as its perception changed; images show each factor where it is."""
    learner, _, begun = trained
    shown = list(learner.perceived())
    assert [each.episodes for each in shown] == begun and len(set(each.sizes for each in shown)) > 1
    assert shown[-1].sizes == learner.perception.sizes
    mask = np.any([part.mask for factor in learner.perception.found for part in factor.parts], axis=0)
    colored = np.ptp(shown[-1].picture[::5, ::5], axis=2) > 0
    assert np.array_equal(colored, mask), "gray where nothing is told apart"


def late(learner: LearnedPerceptionAgent) -> list[NDArray[np.float32]]:
    """Values at the beginning of an episode, and when one macro-action is left."""
    seen = Observation(frame=picture(starts()[0], np.random.default_rng(0)))
    learner.begin_episode()
    values = [learner.q_values(seen)]
    for _ in range(5):
        learner.act(seen, explore=False)
    values.append(learner.q_values(seen))
    learner.begin_episode()
    return values


def test_actions_frames_and_episode_lengths_are_remembered(trained: Trained) -> None:
    learner, taken, _ = trained
    resumed = agent(seed=5)
    resumed.restore(learner.state())
    for eyes in (learner.perception, resumed.perception):
        _, begins, actions = eyes.first(len(eyes.frames))
        assert actions[actions >= 0].tolist() == taken
        assert begins.sum() == EPISODES
        assert np.array_equal(actions < 0, np.roll(begins, -1)), "nothing was done in an episode's last frame"
        assert eyes.first(8)[2][-1] < 0, "a transition to a later frame is none of the first"
    np.testing.assert_array_equal(late(resumed), late(learner))
    state = learner.state()
    resumed.restore(AgentState(arrays=state.arrays, values={**state.values, "longest": 6}))
    assert np.abs(np.subtract(*late(resumed))).max() > 1.0, "with one macro-action left, other things are worth doing"
    for transition in [next(played(None, np.random.default_rng(0)))] * 5:  # another's, which it only watches
        resumed.observe(replace(transition, terminated=False), episode=EPISODES)
    watched = resumed.q_values(Observation(frame=picture(starts()[0], np.random.default_rng(0))))
    np.testing.assert_array_equal(late(resumed)[1], watched)
    resumed.reset_for_new_task()
    assert resumed.state().values["longest"] is None, "another task may cut episodes elsewhere"


def cut(learner: LearnedPerceptionAgent, steps: int, seed: int) -> None:
    """Live an episode that is cut off after so many macro-actions, and goes back to its start until then."""
    (first, *_) = played(learner, np.random.default_rng(seed), explore=True)
    for step in range(steps):
        learner.observe(replace(first, terminated=False, truncated=step + 1 == steps), episode=seed)


def test_the_longest_episode_that_was_cut_is_the_time_that_there_is() -> None:
    learner = agent()
    longest = []
    for seed, steps in enumerate((3, 5, 2)):
        cut(learner, steps, seed)
        longest.append(learner.state().values["longest"])
    assert longest == [3, 5, 5]
