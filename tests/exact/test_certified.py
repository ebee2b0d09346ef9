"""A bench keeps the certificate of its world, and starts where its split says."""

from __future__ import annotations

import dataclasses
import time

import pytest
from small_runs import Inline, small

from imagine_bench import registry
from imagine_bench.exact.certificate import certificate
from imagine_bench.exact.splits import split_of
from imagine_bench.report.data import collect
from imagine_bench.running.bench import bench, load_bench
from imagine_bench.store.loading import archive_files, load_so_far


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    wanted = small(agents=("table",), split="plan_length=2")
    return bench(wanted, {}, root=tmp_path_factory.mktemp("runs"), launcher=Inline())


def test_training_and_tests_start_where_the_split_says(result):
    split = split_of(registry.task("arrow_puzzle").rules, "plan_length=2")
    (run,) = result.runs
    trained = {tuple(start) for start in run.training.starts.tolist()}
    tested = {tuple(start) for row in run.checkpoints for start in row.kept.starts.tolist()}
    assert trained and trained <= set(split.train)
    assert tested and tested <= set(split.test)
    assert result.protocol.split == split.identity


def test_the_certificate_is_that_of_the_tests_starts(result):
    spec = result.protocol.spec(testing=True)
    assert result.certificate == certificate(spec)
    assert result.certificate.starts < 54 == len(registry.task("arrow_puzzle").rules.start_states)
    assert min(length for length, _ in result.certificate.plan_lengths) == 3
    facts = collect(result).facts
    assert (facts.chance_level, facts.optimum) == (result.certificate.chance_level, 1.0)
    assert facts.chance_level < registry.task("arrow_puzzle").facts().chance_level


def test_it_is_read_back_and_drawn(result, tmp_path):
    """A kept one that says something else is read as it is: nothing is computed again."""
    assert load_bench(result.folder).certificate == result.certificate
    other = dataclasses.replace(result.certificate, macrostates=7)
    for kept in (result.certificate, other):
        for name, text in archive_files(dataclasses.replace(result, certificate=kept)).items():
            (tmp_path / name).write_text(text)
        assert load_so_far(tmp_path).certificate == kept


def test_a_learner_that_has_seen_all_that_is_unsure_plans_again():
    """Of the clockwise puzzle some conditions are never told apart: all points that they decide are seen instead."""
    started_s = time.process_time()
    found = certificate(registry.task("arrow_puzzle_clockwise"))
    assert found.learning_cost is not None and found.optimum == 1.0
    assert 56 < found.learning_cost.transitions < found.macrostates * 6  # facts; all that a table could need
    assert time.process_time() - started_s < 30.0
