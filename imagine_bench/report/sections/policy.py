"""The section on where greedy policies lead by the rules, from every start: exact, no episode is sampled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from imagine_bench.interfaces import Floats, State, TaskSpec
from imagine_bench.judge.policy import Terminations, optimal_length, terminations
from imagine_bench.report.data import ReportData
from imagine_bench.report.tables import Section, Table
from imagine_bench.report.text import agent_words, mean_text, percent
from imagine_bench.rules import greedy

_SHARES = {
    "success": "solved", "failure": "ends otherwise", "late_success": "out of time, then solved",
    "late_failure": "out of time, then ends otherwise", "endless": "never ends",
}  # fmt: skip
_SURE = 0.999  # from here on a start counts as always solved: rules may leave something to chance
_LISTED = 12  # starts that are listed, those solved least
Found = Mapping[str, Sequence[Terminations]]
"""By agent, where the policy of each of its seeds leads."""


def followed(data: ReportData) -> Found:
    """The learners whose macro-action in every macrostate was kept at the last budget, followed from the tests' starts.

    In each macrostate an agent does what it did in a frame of it that it read right, if one of a few was.
    """
    spec, found = data.spec, dict[str, list[Terminations]]()
    for agent in data.result.protocol.agents if spec.action_names else ():
        held = [run.checkpoints[-1].beliefs for run in data.result.of(agent)]
        if all(held):
            policies_of = [greedy(one.action.astype(np.int64), spec.n_actions) for one in held if one]
            found[agent] = [terminations(spec, one, _starts(data)) for one in policies_of]
    return found


def _starts(data: ReportData) -> tuple[State, ...]:
    """Those of the tests."""
    return data.result.protocol.spec(testing=True).rules.start_states


def policies(data: ReportData, found: Found) -> Section:
    """What policies do from every start, by the shortest plan, and from the starts that they miss."""
    starts = _starts(data)
    optimal, episodes = optimal_length(data.spec, starts), f"{data.budgets[-1]:,} real episodes"
    solved = np.array([np.mean([one.success for one in seeds], axis=0) for seeds in found.values()])  # [agents, starts]
    titles = [agent_words(agent).title for agent in found]
    rows = [
        [title, *(mean_text([float(getattr(one, name).mean()) for one in seeds]) for name in _SHARES),
         mean_text([float(one.length.mean()) for one in seeds], "{:.2f}".format)]
        for title, seeds in zip(titles, found.values(), strict=True)
    ]  # fmt: skip
    needs = optimal.round().astype(int)
    by_need = [
        [str(need), str((needs == need).sum()), *map(percent, solved[:, needs == need].mean(axis=1))]
        for need in np.unique(needs)
    ]
    tables = [
        Table(
            name="policies", rows=rows,
            header=["agent, %", *_SHARES.values(), f"macro-actions (optimal: {optimal.mean():.2f})"],
            caption=f"After {episodes}, from all {len(starts)} starts. Means over seeds [95 %].",
        ),
        Table(name="policies_by_length", header=["optimal macro-actions", "starts", *titles], rows=by_need,
              caption="Solved, %, by what an optimal agent needs.", folded="By the length of the optimal plan"),
    ]  # fmt: skip
    worst = np.min([one.success for seeds in found.values() for one in seeds], axis=0)  # [starts]
    if missed := [index for index in np.argsort(solved.mean(axis=0), kind="stable") if worst[index] < _SURE]:
        tables.append(_missed(data.spec, [starts[at] for at in missed], optimal[missed], solved[:, missed], titles))
    words = "Each policy is followed by the rules: no episode is sampled, and no frame misread that can be read right."
    return Section(title="Where the greedy policies lead", words=[words], tables=tables)


def _missed(spec: TaskSpec, starts: Sequence[State], optimal: Floats, solved: Floats, titles: Sequence[str]) -> Table:
    def words(state: State) -> str:
        named = zip(spec.macrostate_names, spec.value_names(state), strict=True)
        return ", ".join(f"{name} {value}" for name, value in named)

    rows = zip(starts[:_LISTED], optimal[:_LISTED], solved.T[:_LISTED], strict=True)
    return Table(
        name="policies_missed", header=["start", "optimal macro-actions", *titles],
        rows=[[words(start), f"{need:.2f}", *map(percent, shares)] for start, need, shares in rows],
        caption=f"Solved, %. {len(starts)} starts are not always solved by every run.",
        folded="The starts that are solved least",
    )  # fmt: skip
