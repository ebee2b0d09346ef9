"""The best known learners that ``describe`` names are those of the kept results."""

from __future__ import annotations

import json
import re
from importlib import resources

import pytest
from doc_cells import price_to, scores
from kept import ROOT

from imagine_bench.tools.describe import describe_task

BEST = json.loads(resources.files("imagine_bench.exact").joinpath("best_known.json").read_text())


@pytest.mark.parametrize("task", BEST)
def test_the_best_known_is_recomputed(task: str) -> None:
    best = BEST[task]
    where = f"{best['results']}/{best['row']}"
    assert f"{best['macro_actions']:,}" == price_to(where, "0.95", "env_steps")
    assert best["seeds"] == len(scores("60", where))


def test_describe_names_bound_best_known_and_cautious_learner() -> None:
    page = describe_task("arrow_puzzle")
    bound, best, cautious = (page.index(text) for text in ("12 transitions", "80 macro-actions", "112 ± "))
    assert bound < best < cautious
    assert "best known" not in describe_task("arrow_puzzle_easy")
    (quoted,) = re.findall(r"```text\n(.*?)```", (ROOT / "docs/explanation/certificates.md").read_text(), re.DOTALL)
    assert set(quoted.splitlines()) <= set(page.splitlines())
