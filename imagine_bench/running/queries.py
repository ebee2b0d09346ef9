"""What a learner is given beside its own episodes: demonstrated ones, labels for what it asks, a teacher's feedback.

None shows a macrostate: a demonstration is seen as frames, a label is a reward and whether the episode would end, and
feedback is reward.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from imagine_bench import registry
from imagine_bench.arrays import Info
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Agent, Observation, Rules, Transition
from imagine_bench.interfaces.capabilities import ExternalTrainer, Label, QueryingAgent, TransferLearner
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.runs import RunSpec
from imagine_bench.rules import optimal_actions, tabulate


def require_able(agent: object, name: str, protocol: Protocol) -> None:
    """Raise InvalidValueError where a learner cannot carry over to the next task, watch or ask, as a protocol wants."""
    if protocol.demonstrations and isinstance(agent, ExternalTrainer):
        raise InvalidValueError(
            f"Agent {name!r} trains in a loop of its own and cannot watch; leave --demonstrations out, or that agent."
        )
    if protocol.dataset and (isinstance(agent, ExternalTrainer) or registry.agent_entry(name).privileged):
        why = "trains in a loop of its own" if isinstance(agent, ExternalTrainer) else "is shown true macrostates"
        raise InvalidValueError(
            f"Agent {name!r} {why} and cannot learn from a dataset; leave --dataset out, or that agent."
        )
    if protocol.after and not isinstance(agent, TransferLearner):
        raise InvalidValueError(
            f"Agent {name!r} has no model of the world to carry over from {', '.join(protocol.after)}; leave --after "
            "out, or give agents that have one, such as factored:given or imagination."
        )
    if protocol.queries and not isinstance(agent, QueryingAgent):
        raise InvalidValueError(
            f"Agent {name!r} cannot query an oracle; leave --queries out, or give an agent that can, such as "
            "factored:given."
        )

    if protocol.feedback and isinstance(agent, ExternalTrainer):
        raise InvalidValueError(
            f"Agent {name!r} trains in a loop of its own and gets no feedback; leave --feedback out, or that agent."
        )


def demonstrator(spec: RunSpec[Protocol]) -> Agent:
    """The reference agent that plays the demonstrated episodes of a run; it has to be shown macrostates."""
    return registry.make_agent(registry.DEMONSTRATOR, dataclasses.replace(spec, agent=registry.DEMONSTRATOR).context())


def as_seen(transition: Transition) -> Transition:
    """A demonstrated transition as a learner may see it: without macrostates."""
    before, after = (
        dataclasses.replace(seen, macrostate=None, shown=None)
        for seen in (transition.observation, transition.next_observation)
    )
    return dataclasses.replace(transition, observation=before, next_observation=after)


class LabelOracle:
    """Labels what actions would bring, from the rules and the true macrostate, where these allow one outcome."""

    def __init__(self, rules: Rules) -> None:
        self._rules = rules

    def label(self, macrostate: tuple[int, ...], actions: NDArray[np.int64]) -> Label | None:
        """What the last of ``actions`` (D,) from ``macrostate`` would bring.

        The scene goes on obeying its dynamics through the ends of episodes. Where chance decides on the way, all that
        may happen is looked at; None where that differs in reward or end: a matter of chance has no label. Raises
        InvalidValueError: no action, or one that does not exist.
        """
        planned = [int(action) for action in actions]
        if not planned or not all(0 <= action < self._rules.n_actions for action in planned):
            raise InvalidValueError(
                f"Asked about the actions {planned}; give at least one, each from 0 to {self._rules.n_actions - 1}."
            )
        possible = {macrostate}
        for action in planned[:-1]:
            possible = {each.macrostate for state in possible for each in self._rules.outcomes(state, action)}
        labels = {
            Label(outcome.reward, outcome.terminated)
            for state in possible
            for outcome in self._rules.outcomes(state, planned[-1])
        }
        return labels.pop() if len(labels) == 1 else None


class Teacher:
    """Watches a learner, and tells after each macro-action whether it was optimal (thesis 6: teacher feedback).

    The learner sees that as reward on top of the world's own: ``feedback`` where an optimal agent could have chosen the
    action, else minus that. With probability ``error`` the teacher says the opposite.
    """

    def __init__(self, rules: Rules, feedback: float, error: float) -> None:
        tables = tabulate(rules)
        self._rows = tables.index
        self._optimal = optimal_actions(tables)
        self._feedback = feedback
        self._error = error

    def begin(self, seed: int) -> None:
        """A new episode, of which ``seed`` decides the errors."""
        self._rng = np.random.default_rng(seed)

    def __call__(self, observation: Observation, info: Info) -> None:
        """See where the learner is about to act."""
        self._row = self._rows[tuple(int(value) for value in info["macrostate"])]

    def told(self, transition: Transition) -> Transition:
        """The transition that followed, with what the teacher says of it in its reward."""
        right = bool(self._optimal[transition.action, self._row]) != bool(self._rng.random() < self._error)
        return dataclasses.replace(
            transition, reward=transition.reward + (self._feedback if right else -self._feedback)
        )


class QueryBudget:
    """The ``queries`` that ``learner`` may ask in one episode, before each of its macro-actions."""

    def __init__(self, learner: QueryingAgent, oracle: LabelOracle, queries: int) -> None:
        self._learner = learner
        self._oracle = oracle
        self._left = queries
        self.asked = 0

    def __call__(self, observation: Observation, info: Info) -> None:
        """Let the learner ask at a real frame until it has nothing to ask or may not any more."""
        while self._left > 0:
            actions = self._learner.query(observation)
            if actions is None:
                return
            macrostate = tuple(int(value) for value in info["macrostate"])
            self._learner.learn_label(observation, actions, self._oracle.label(macrostate, actions))
            self._left = self._left - 1
            self.asked = self.asked + 1
