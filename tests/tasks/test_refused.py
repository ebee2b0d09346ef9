"""Worlds and options that there are not: each is refused in one sentence, by whoever is asked for it."""

from __future__ import annotations

import json
import re

import gymnasium
import pytest
from storms import one_sentence
from whole_outputs import KEPT

from imagine_bench import registry
from imagine_bench.errors import ImagineBenchError
from imagine_bench.protocols.control import protocol


def test_worlds_and_options_that_there_are_not(expected):
    """A line is a task's name, or the name of an environment and its options."""
    answers = []
    for asked in re.findall(r"^\$ (.*)$", (KEPT / "refused.txt").read_text(encoding="utf-8"), re.MULTILINE):
        name, _, options = asked.partition(" ")
        doors = [lambda name, options=options: gymnasium.make(f"imagine_bench/{name}-v0", **json.loads(options))]
        said = set()
        for door in doors if options else (registry.task, registry.task_entry, protocol):
            with pytest.raises(ImagineBenchError) as caught:
                door(name)
            said.add(one_sentence(caught.value))
        answers += [f"$ {asked}", *said]
    assert len(answers) > 150
    expected("refused", "\n".join(answers))
