"""The registry lines of programs and of the writer of laws; torch is not imported before one is made."""

from __future__ import annotations

from imagine_bench.registry import AgentEntry, WorldModelEntry

_ARGUMENT = "imagine_bench_programs.program:spelled"
_SETTINGS = "imagine_bench_programs.settings:HYPERPARAMETERS"
_TITLE = "program (symbols given)"
_RUNS = "ARGUMENT is a file of Python with a function from symbols and action to outcomes, such as program:FILE.py."
_LAWS = "the shortest laws with preconditions that explain the transitions, on given codes; without a network."

PROGRAM = AgentEntry(
    make="imagine_bench_programs.agent:make_program",
    learns=False,
    encoder_kind="codes",
    settings=_SETTINGS,
    argument=_ARGUMENT,
    title=_TITLE,
    description=f"Plans by value iteration in a program that somebody wrote. {_RUNS}",
)
LAWS_GIVEN = AgentEntry(
    make="imagine_bench_programs.agent:make_laws",
    encoder_kind="codes",
    title="laws (codes given)",
    description=f"Writes a program from its own transitions, and plans in it: {_LAWS}",
)
PROGRAM_MODEL = WorldModelEntry(
    make="imagine_bench_programs.model:make_program",
    encoder_kind="codes",
    settings=_SETTINGS,
    argument=_ARGUMENT,
    title=_TITLE,
    description=f"A program that somebody wrote; it learns nothing. {_RUNS}",
)
LAWS_MODEL = WorldModelEntry(
    make="imagine_bench_programs.model:make_laws",
    encoder_kind="codes",
    title="laws (codes given)",
    description=f"A program that is written from the data: {_LAWS}",
)
