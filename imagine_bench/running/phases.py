"""What a run does between two budgets: training in all its forms, and the test."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing

from imagine_bench.arrays import Info
from imagine_bench.environments import Env
from imagine_bench.interfaces import Observation
from imagine_bench.interfaces.capabilities import (
    ExternalTrainer,
    ModelOnlyTrainer,
    QueryingAgent,
    TransferLearner,
    begin_episode,
)
from imagine_bench.interfaces.episodes import Episodes
from imagine_bench.running.evaluation import (
    EvaluationCounts,
    TrainingStarts,
    play,
    play_test_episode,
)
from imagine_bench.running.lanes import episodes_in_lanes, lanes_pay
from imagine_bench.running.queries import LabelOracle, QueryBudget, Teacher, as_seen
from imagine_bench.running.run_state import CountVisits, Run, make_env
from imagine_bench.seeding import episode_seed, evaluation_split


def transfer(run: Run) -> None:
    """Train on the tasks that come before; after the last episode of each, the agent takes its model to the next."""
    if not isinstance(run.agent, TransferLearner):
        return
    protocol = run.protocol
    counters = run.counters
    for index, task in enumerate(protocol.after):
        end = (index + 1) * protocol.after_episodes
        if counters.before >= end:
            continue
        with closing(make_env(protocol, task)) as env:
            while counters.before < end:
                with run.training_time():
                    _earlier_episode(run, env)
                    if counters.before == end:
                        run.agent.reset_for_new_task()
                run.made_progress("training")


def _earlier_episode(run: Run, env: Env) -> None:
    seed = episode_seed("earlier_training", run.spec.seed, run.counters.before)
    for transition, _ in play(env, run.agent, seed=seed, explore=True, privileged=False):
        run.agent.observe(transition, episode=run.counters.before % run.protocol.after_episodes)
    run.counters.before += 1


def train(run: Run, budget: int) -> None:
    """Train until the agent has had ``budget`` episodes: first those of a dataset or demonstrated, then its own."""
    offline = 0 if run.dataset is None else len(run.dataset)
    while run.counters.episode < budget:
        with run.training_time():
            if run.dataset is not None and run.counters.episode < offline:
                _episode_of_dataset(run, run.dataset)
            else:
                _training_episode(run, demonstrated=run.counters.episode < run.protocol.demonstrations)
        run.made_progress("training")


def _episode_of_dataset(run: Run, dataset: Episodes) -> None:
    counters = run.counters
    episode = run.counters.episode
    begin_episode(run.agent)
    for transition in dataset.transitions(episode):
        run.agent.observe(transition, episode=episode)
    counters.add_episode(bool(dataset.success[episode]), int(dataset.lengths[episode]))


def _training_episode(run: Run, *, demonstrated: bool) -> None:
    counters = run.counters
    length = 0
    success = False
    seed = episode_seed("training", run.spec.seed, counters.episode)
    if demonstrated:
        begin_episode(run.agent)  # an agent that acts is told by play()
    queries = None if demonstrated else _queries(run)
    teacher = None if demonstrated else _teacher(run)
    watching = [each for each in (queries, teacher) if each is not None]

    def before_acting(observation: Observation, info: Info) -> None:
        for watcher in watching:
            watcher(observation, info)

    episode = play(
        CountVisits(run.env, counters),
        run.demonstrator if demonstrated else run.agent,
        seed=seed,
        explore=True,
        privileged=demonstrated or run.entry.privileged,
        before_acting=before_acting,
    )
    for lived, info in episode:
        transition = lived if teacher is None else teacher.told(lived)
        run.agent.observe(transition if run.entry.privileged else as_seen(transition), episode=counters.episode)
        length = length + 1
        success = bool(info["is_success"])
    counters.add_episode(success, length, queries=0 if queries is None else queries.asked)


def _queries(run: Run) -> QueryBudget | None:
    """What the agent may ask in its next episode, if anything."""
    if not run.protocol.queries or not isinstance(run.agent, QueryingAgent):
        return None
    return QueryBudget(run.agent, LabelOracle(run.task.rules), run.protocol.queries)


def _teacher(run: Run) -> Teacher | None:
    """Who watches the agent's next episode, if anybody."""
    if run.teacher is not None:
        run.teacher.begin(episode_seed("feedback", run.spec.seed, run.counters.episode))
    return run.teacher


def train_externally(run: Run, agent: ExternalTrainer, test: Callable[[int], None]) -> None:
    """Let the agent train in its own loop through all budgets, and test it, in an environment apart, at each."""
    budgets = run.protocol.budgets
    start_s = time.process_time()

    def on_episode(success: bool, length: int) -> bool:
        nonlocal start_s
        run.counters.add_episode(success, length)
        run.counters.train_cpu_s += time.process_time() - start_s
        run.tell("training")
        if run.counters.episode in budgets:
            test(run.counters.episode)
        start_s = time.process_time()
        return run.counters.episode < budgets[-1]

    with closing(make_env(run.protocol, run.task.id)) as own:
        starts = TrainingStarts(CountVisits(own, run.counters), run.spec.seed)
        agent.train(starts, episodes=budgets[-1], horizon=run.task.horizon, on_episode=on_episode)


def train_in_model(run: Run) -> None:
    """Let an agent that trains in its model alone do so; its time counts as training."""
    more = isinstance(run.agent, ModelOnlyTrainer)
    while more and isinstance(run.agent, ModelOnlyTrainer):
        with run.training_time():
            more = run.agent.train_in_model()
        run.made_progress("training in the model")


def test(run: Run) -> EvaluationCounts:
    """Play the greedy test episodes of the budget that was reached, or those that a resumed run has left."""
    counters = run.counters
    if counters.test is None:
        train_in_model(run)
        counters.test = EvaluationCounts(diagnostics=run.agent.diagnostics())
    purpose = evaluation_split(run.spec.seed)
    privileged = run.entry.privileged
    seeds = [episode_seed(purpose, 0, each) for each in range(counters.test.episodes, run.protocol.evaluation_episodes)]
    if lanes_pay(run, len(seeds)):
        start_s = time.process_time()
        for played in episodes_in_lanes(run, seeds):
            counters.test.add(played)
            counters.test.cpu_s += time.process_time() - start_s
            run.made_progress("testing")
            start_s = time.process_time()
    while counters.test.episodes < run.protocol.evaluation_episodes:
        play_test_episode(counters.test, run.test_env, run.agent, privileged=privileged, purpose=purpose)
        run.made_progress("testing")
    return counters.test
