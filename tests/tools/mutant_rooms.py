"""The files in which ``make mutants`` plants small bugs, and the tests that should notice them."""

from __future__ import annotations

from collections.abc import Sequence

_RULES = ("tests/tasks/arrows/test_arrow_rules.py", "tests/tasks/pick_place/test_pick_place_rules.py")
_FACTORED = (
    "agents/guests/factored/tests/test_factored_formulas.py", "agents/guests/factored/tests/test_factored.py",
    "agents/guests/factored/tests/test_transfer.py",
)  # fmt: skip
_CHECKPOINTS = ("tests/store/test_checkpoints.py", "tests/running/test_runner.py")
ROOMS: dict[str, dict[str, Sequence[str]]] = {
    "rules": {
        "tasks/arrows/rules.py": _RULES[:1],
        "tasks/pick_place/rules.py": _RULES[1:],
        "imagine_bench/rules.py": _RULES,
    },
    "filter": {
        "agents/imagination/filter.py": (
            "tests/agents/imagination/test_rollouts.py", "tests/agents/imagination/test_model_only.py",
        ),
    },
    "uncertainties": {
        "agents/imagination/uncertainty.py": ("tests/agents/imagination/test_uncertainty.py",),
        "agents/imagination/mixture.py": (
            "tests/agents/imagination/test_mixture.py", "tests/agents/imagination/test_uncertainty.py",
        ),
    },
    "statistics": {"imagine_bench/statistics.py": ("tests/test_statistics.py",)},
    "resume": {
        "imagine_bench/store/run_folder.py": _CHECKPOINTS,
        "imagine_bench/values.py": _CHECKPOINTS,
        "imagine_bench/running/evaluation.py": _CHECKPOINTS,
        "imagine_bench/running/run_state.py": _CHECKPOINTS[::-1],
    },
    "report": {
        "imagine_bench/report/data.py": (
            "tests/report/test_report_data.py", "tests/report/test_filmstrips.py", "tests/report/test_report.py",
        ),
    },
    "own agent": {
        f"agents/guests/factored/src/imagine_bench_factored/{name}.py": _FACTORED
        for name in ("agent", "dynamics", "factors", "model", "outcomes", "perception", "planner")
    },
}  # fmt: skip
"""Of each room the files, and the tests of each file, those that find most first."""
