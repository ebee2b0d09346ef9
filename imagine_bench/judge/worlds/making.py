"""How the questions about a whole world are drawn. Everything random comes from the generator that is given."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from imagine_bench.arrays import Bools, Floats, Ints, State
from imagine_bench.interfaces import TaskSpec
from imagine_bench.judge.worlds.families import (
    STREAM,
    ChangedRule,
    FactorsChanged,
    Family,
    LuckAlone,
    MaskedFrames,
    Reachability,
    ShortestPlans,
    SingleCausePairs,
    TwoWorlds,
)
from imagine_bench.judge.worlds.graph import edges_of_rules
from imagine_bench.judge.worlds.tables import (
    LIKELY,
    ChangedWorld,
    Transitions,
    TransitionTable,
    coupled_pair,
    drawn_from,
    exact_table,
    fewest,
    other_action,
    reaching,
    usual,
    with_coupling,
    with_slips,
)
from imagine_bench.judge.worlds.words import NO, YES, Named
from imagine_bench.seeding import SeedTree

QUERIES = 160  # questions of each family
PAIRS = 40  # pairs of each single cause
CHOICES = 4  # images to choose from
GOALS = 64  # goals that plans are asked for
LONGEST = 6  # macro-actions of the longest plan
_TRIED = 20  # times as many candidates are drawn where answers are to be balanced
LOOK = "look"
"""The cause of two frames that show one macrostate."""


@dataclass(frozen=True, kw_only=True)
class WorldQuestions:
    """All questions about a world."""

    states: tuple[State, ...]  #: the T macrostates
    truth: TransitionTable
    families: tuple[Family, ...]
    edges: Bools  #: of the rules' factor graph, as :func:`.graph.edges_of_rules`
    named: Named  #: the world's names, for a person


def whole_world(spec: TaskSpec, states: Sequence[State], frames: int, *, frames_vary: bool) -> WorldQuestions:
    """The questions that every model and every person is asked about a task; as :func:`world_questions`."""
    rng = SeedTree(0).child("evaluation", "judge", "worlds", spec.id).generator()
    return world_questions(spec, states, frames, rng, frames_vary=frames_vary)


def world_questions(
    spec: TaskSpec, states: Sequence[State], frames: int, rng: np.random.Generator, *, frames_vary: bool
) -> WorldQuestions:
    """Draw the questions about a world; families that the world leaves nothing to ask of are left out.

    Args:
        spec: The task.
        states: Every macrostate in which an episode goes on. Length S.
        frames: Frames of each macrostate, F.
        rng: Draws the questions and the order of their answers.
        frames_vary: Whether the frames of one macrostate differ.
    """
    every, truth = exact_table(spec.rules, tuple(states), frames)
    world = _World(np.array(every, dtype=np.int64), truth, rng)
    families = [*_masked_frames(world), *_plans(world, min(spec.horizon, LONGEST)), *_streams(world)]
    families += _single_causes(world, spec.macrostate_names, frames_vary=frames_vary)
    named = Named(every, spec.action_names, spec.macrostate_names)
    edges = edges_of_rules(spec.rules)
    return WorldQuestions(states=every, truth=truth, families=tuple(families), edges=edges, named=named)


@dataclass(frozen=True)
class _World:
    """The material of questions."""

    coordinates: Ints  # shape (T, M)
    truth: TransitionTable
    rng: np.random.Generator

    @property
    def n_states(self) -> int:
        """S."""
        return len(self.truth.drawn)

    @property
    def lasting(self) -> Bools:
        """Whether the episode surely goes on after each macro-action. Shape (S, A)."""
        ends = self.truth.mean[:, :, self.n_states :].sum(axis=2)
        return np.asarray(ends == 0.0)

    def transitions(self, *shape: int) -> Transitions:
        """Random macro-actions in random macrostates; their results are still to be drawn."""
        states, actions, frames = (self.rng.integers(size, size=shape) for size in self.truth.drawn.shape)
        return Transitions(states=states, actions=actions, frames=frames, reached=states)

    def drawn(self, asked: Transitions, world: ChangedWorld = usual) -> Transitions:
        """The same with results that are drawn in a world."""
        return replace(asked, reached=drawn_from(world, self.truth, asked, self.rng))

    def some(self, where: Bools, count: int) -> Ints:
        """So many drawn places at which an array (I, J) is true. Shape (N, 2)."""
        places = np.argwhere(where)
        return places[self.rng.integers(len(places), size=count)]

    def shuffled(self, values: Iterable[int], rows: int) -> Ints:
        """The same answers for each question, each time in another order. Shape (N, C)."""
        return self.rng.permuted(np.tile(np.array(list(values), dtype=np.int64), (rows, 1)), axis=1)

    def images(self, possible: Ints, likely: Ints, of: int) -> list[int]:
        """Different rows below ``of`` in a random order: the possible ones, then likely ones, then any."""
        rows = [possible, self.rng.permutation(likely), self.rng.permutation(of)]
        every = dict.fromkeys(itertools.chain.from_iterable(each.tolist() for each in rows))
        return self.rng.permutation(list(every)[: min(CHOICES, of)]).tolist()


def _masked_frames(world: _World) -> list[Family]:
    """Pairs of macro-actions of which the first surely leaves the episode going on."""
    if not world.lasting.any() or world.n_states < 2:
        return []
    states, actions = world.some(world.lasting, QUERIES).T
    first = world.drawn(replace(world.transitions(QUERIES), states=states, actions=actions))
    second = world.drawn(replace(world.transitions(QUERIES), states=first.reached, frames=first.frames))
    mean = world.truth.mean[:, :, : world.n_states]
    options = []
    for start, done, then, last in zip(states, actions, second.actions, second.reached, strict=True):
        possible = np.flatnonzero(mean[start, done] * world.truth.mean[:, then, last])
        near = np.append(np.flatnonzero(mean[start].sum(axis=0)), start)
        options.append(world.images(possible, near, world.n_states))
    return [MaskedFrames(first=first, actions=second.actions, reached=second.reached, options=np.array(options))]


def _plans(world: _World, longest: int) -> list[Family]:
    """Both kinds of questions about goals."""
    goals = np.flatnonzero(world.truth.mean.sum(axis=(0, 1))[:-1])
    goals = np.sort(world.rng.permutation(goals)[:GOALS])
    chances = reaching(world.truth, goals, longest)  # [D, S, G]
    needed = fewest(chances)
    needed[np.arange(len(needed))[:, None] == goals] = -1  # the goal is there already
    lengths = [length for length in range(1, longest + 1) if (needed == length).any()]
    found: list[Family] = []
    if len(lengths) > 1:
        places = [world.some(needed == length, QUERIES // len(lengths)) for length in lengths]
        starts, columns = np.concatenate(places).T
        options = world.shuffled(lengths, len(starts))
        found.append(ShortestPlans(starts=starts, goals=goals[columns], options=options))
    within = [length for length in lengths if (needed == length + 1).any()]
    if within:
        count = QUERIES // len(within)
        places = [_within(world, chances[k - 1], needed == k, needed == k + 1, count) for k in within]
        starts, columns = np.concatenate(places).T
        ks = np.repeat(within, count)
        options = world.shuffled((YES, NO), len(starts))
        found.append(Reachability(starts=starts, goals=goals[columns], within=ks, options=options))
    return found


def _within(world: _World, chances: Floats, in_time: Bools, just_late: Bools, count: int) -> Ints:
    """Starts and goals (N, 2) whose mean probability is one half, so that the number of macro-actions tells nothing."""
    high = chances[in_time].mean()
    low = chances[just_late].mean()
    early = round(count * float((LIKELY - low) / (high - low)))
    return np.concatenate([world.some(in_time, early), world.some(just_late, count - early)])


def _streams(world: _World) -> list[Family]:
    """Streams of each possible world, about as many of each."""
    if world.truth.drawn.shape[1] < 2:
        return []
    rng = world.rng
    shape = (QUERIES, STREAM)
    yes = rng.permutation(QUERIES)[:, None] % 2 == YES
    steps = np.arange(STREAM)

    asked = world.transitions(*shape)
    shown = _where(yes, world.drawn(asked, with_slips), world.drawn(asked))
    two = TwoWorlds(shown=shown, options=world.shuffled((NO, YES), QUERIES))

    asked = world.transitions(*shape)
    meddled = ~yes & (steps == rng.integers(STREAM, size=(QUERIES, 1)))
    shown = _where(meddled, world.drawn(asked, other_action), world.drawn(asked, with_slips))
    luck = LuckAlone(shown=shown, options=world.shuffled((NO, YES), QUERIES))

    one, other = coupled_pair(world.truth)
    asked = world.transitions(*shape)
    often = rng.random(shape) < LIKELY  # half are of the coupled macro-action, where its coupling shows
    if world.lasting[:, one].any():
        states = world.some(world.lasting[:, one, None], often.size)[:, 0].reshape(shape)
        asked = replace(
            asked, states=np.where(often, states, asked.states), actions=np.where(often, one, asked.actions)
        )
    changed = steps >= rng.permutation(QUERIES)[:, None] % (STREAM + 1)
    shown = _where(changed, world.drawn(asked, with_coupling(one, other)), world.drawn(asked))
    options = world.shuffled(range(STREAM + 1), QUERIES)
    return [ChangedRule(shown=shown, pair=(one, other), options=options), two, luck]


def _where(chosen: Bools, one: Transitions, other: Transitions) -> Transitions:
    """The results of ``one`` where ``chosen`` is true, of ``other`` elsewhere."""
    return replace(one, reached=np.where(chosen, one.reached, other.reached))


# Single causes -----------------------------------------------------------------------------------------------------


def _single_causes(world: _World, names: Sequence[str], *, frames_vary: bool) -> list[Family]:
    """Pairs of starts that differ in one coordinate, or only in how they look; and the effects of each cause."""
    play = world.coordinates[: world.n_states]
    differ = play[:, None] != play[None]  # [S, S, M]
    alone = {name: differ[..., i] & (differ.sum(axis=2) == 1) for i, name in enumerate(names)}
    alone[LOOK] = np.eye(len(play), dtype=bool) & frames_vary
    causes = [name for name, where in alone.items() if where.any()]
    if not causes:
        return []
    states = np.concatenate([world.some(alone[cause], PAIRS) for cause in causes])  # [pairs, 2]
    asked = world.transitions(*states.shape)
    asked = replace(asked, states=states, actions=asked.actions[:, :1].repeat(2, axis=1))
    if frames_vary:
        asked.frames[-PAIRS:] = (0, 1)
    options = np.array([_outcomes(world, of_pair) for of_pair in usual(world.truth, asked)])
    pairs = SingleCausePairs(shown=asked, causes=tuple(np.repeat(causes, PAIRS).tolist()), options=options)
    return [_factors_changed(world, pairs), pairs]


def light_pairs(spec: TaskSpec, states: tuple[State, ...], actions: Ints, rng: np.random.Generator) -> WorldQuestions:
    """Pairs of frames of one macrostate in two lights, and a macro-action: which macrostate follows?

    Args:
        spec: The task.
        states: The macrostate of each pair. Length P.
        actions: The macro-action of each pair, the only one that the tables of these questions hold. Shape (P,).
        rng: Draws the possible answers.
    """
    every, table = exact_table(spec.rules, states, 2)
    rows = np.arange(len(states))
    truth = TransitionTable(by_frame=table.by_frame[rows, actions, None], drawn=table.drawn[rows, actions, None])
    world = _World(np.array(every, dtype=np.int64), truth, rng)
    both = np.repeat(rows[:, None], 2, axis=1)
    frame = np.tile([0, 1], (len(rows), 1))
    shown = Transitions(states=both, actions=np.zeros_like(both), frames=frame, reached=both)
    options = np.array([_outcomes(world, of_pair) for of_pair in usual(truth, shown)])
    pairs = SingleCausePairs(shown=shown, causes=("light",) * len(states), options=options)
    no_edges = np.zeros((0, 0, 0), dtype=bool)
    named = Named(every, spec.action_names, spec.macrostate_names)
    return WorldQuestions(states=every, truth=truth, families=(pairs,), edges=no_edges, named=named)


def _outcomes(world: _World, shares: Floats) -> list[list[int]]:
    """Possible outcomes of each member of a pair; wrong ones are those of the other, or have one factor altered."""
    possible = [np.flatnonzero(law) for law in shares[:, :-1]]
    found = []
    for own, of_other in zip(possible, reversed(possible), strict=True):
        altered = (world.coordinates != world.coordinates[own[0]]).sum(axis=1) == 1
        likely = np.concatenate([of_other, np.flatnonzero(altered)])
        found.append(world.images(own, likely, len(world.coordinates)))
    return found


def _factors_changed(world: _World, pairs: SingleCausePairs) -> FactorsChanged:
    """Factors of the outcomes of pairs: half of them change.

    Of both halves, half have another answer than the starts, so that these tell nothing, as far as there are such.
    """
    rows = world.rng.integers(len(pairs.causes), size=QUERIES * _TRIED)
    factors = world.rng.integers(world.coordinates.shape[1], size=len(rows))
    asked = FactorsChanged(pairs=pairs, rows=rows, factors=factors, coordinates=world.coordinates, options=rows)
    changed = asked.distances(world.truth) >= LIKELY
    starts = world.coordinates[pairs.shown.states[rows], factors[:, None]]
    along = (starts[:, 0] != starts[:, 1]) == changed
    half = QUERIES // 2
    kept: list[int] = []
    for which in (changed, ~changed):
        against = np.flatnonzero(which & ~along)[: half // 2].tolist()
        kept += against + np.flatnonzero(which & along)[: half - len(against)].tolist()
    return replace(asked, rows=rows[kept], factors=factors[kept], options=world.shuffled((YES, NO), len(kept)))
