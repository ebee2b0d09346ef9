"""The files in which ``make mutants`` plants small bugs, and the tests that should notice them."""

from __future__ import annotations

from collections.abc import Sequence

_ARROWS = "tests/tasks/arrows/test_arrow_rules.py"
_PICK_PLACE = "tests/tasks/pick_place/test_pick_place_rules.py"
_WORLDS = (
    "tests/tasks/arrows/test_arrow_oracle.py",
    "tests/tasks/arrows/test_arrow_description.py",
    "tests/tasks/parameters/test_parameters.py",
    "tests/tasks/arrows/test_many_cubes.py",
)
_FACTORED = tuple(
    f"agents/guests/factored/tests/test_{name}.py"
    for name in ("factored_formulas", "factored", "learned", "transfer", "memory", "rewards", "worlds")
)
_CHECKPOINTS = ("tests/store/test_checkpoints.py", "tests/running/test_runner.py")
_PLAYED = (*_CHECKPOINTS[::-1], "tests/running/test_queries.py", "tests/running/test_observations.py")
ROOMS: dict[str, dict[str, Sequence[str]]] = {
    "rules": {
        "tasks/arrows/rules.py": (_ARROWS, *_WORLDS),
        "tasks/pick_place/rules.py": (_PICK_PLACE,),
        "imagine_bench/rules.py": (
            "tests/test_rules.py",
            _ARROWS,
            _PICK_PLACE,
            "tests/exact/test_optimum.py",
            "tests/judge/test_truth.py",
        ),
    },
    "filter": {
        "agents/imagination/filter.py": (
            "tests/agents/imagination/test_rollouts.py",
            "tests/agents/imagination/test_model_only.py",
        ),
    },
    "uncertainties": {
        "agents/imagination/uncertainty.py": ("tests/agents/imagination/test_uncertainty.py",),
        "agents/imagination/mixture.py": (
            "tests/agents/imagination/test_mixture.py",
            "tests/agents/imagination/test_uncertainty.py",
        ),
    },
    "statistics": {
        "imagine_bench/statistics.py": ("tests/test_statistics.py", "tests/running/test_headlines.py"),
    },
    "resume": {
        "imagine_bench/store/run_folder.py": _CHECKPOINTS,
        "imagine_bench/values.py": _CHECKPOINTS,
        "imagine_bench/running/evaluation.py": (*_PLAYED, "tests/audit/test_verify.py"),
        "imagine_bench/running/run_state.py": _PLAYED,
    },
    "report": {
        "imagine_bench/report/data.py": (
            "tests/report/test_report_data.py",
            "tests/report/test_filmstrips.py",
            "tests/report/test_report.py",
        ),
    },
    "own agent": {
        f"agents/guests/factored/src/imagine_bench_factored/{name}.py": _FACTORED
        for name in ("agent", "dynamics", "factors", "model", "outcomes", "perception", "planner")
    },
}
"""Of each room the files, and the tests of each file, those that find most first."""
