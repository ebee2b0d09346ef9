"""The thesis' tables, a few of them typed again by hand, and tested against each other."""

from __future__ import annotations

import pytest

from imagine_bench import reference
from imagine_bench.errors import UnknownNameError


def test_tables_5_2_and_5_4_are_what_5_1_and_5_3_imply() -> None:
    for name in ("arrow_puzzle", "arrow_puzzle_hard"):
        base = reference.success(name, "dqn")
        for agent in ("imagination", "imagination_uncertainty"):
            printed, treated = reference.gain(name, agent), reference.success(name, agent)
            assert list(printed) == list(base) == [2000, 3000, 4000, 5000, 6000]
            for episodes, value in printed.items():
                implied = (treated[episodes][0] - base[episodes][0]) / base[episodes][0]
                assert value == pytest.approx(implied, abs=1.1e-4)


def test_every_table_names_its_source() -> None:
    for name in reference.NAMES:
        data = reference.load(name)
        assert "thesis" in data.pop("source")
        assert data
        assert all(part["source"] for part in data.values())


def test_untested_agents_and_unknown_tasks() -> None:
    assert reference.success("arrow_puzzle", "oracle") == {}
    with pytest.raises(UnknownNameError, match=r"No thesis reference 'arow_puzzle'. Did you mean 'arrow_puzzle'\?"):
        reference.success("arow_puzzle", "dqn")
